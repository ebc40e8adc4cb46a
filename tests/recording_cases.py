"""The recorder's node, a simulation to record, and a goal of `collect_rollouts`."""

from pathlib import Path

from rclpy.action import ActionClient

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import names
from tcbi_msgs.action import CollectRollouts


def recorder(folder: Path, lockstep: bool = True, **parameters) -> NodeProcess:
    values = {"folder": str(folder), "use_sim_time": lockstep, "min_free_mb": 1.0, **parameters}
    return NodeProcess("tcbi_infer", "recorder_node", parameters=values)


def simulation(folder: Path, lockstep: bool = True) -> tuple[NodeProcess, NodeProcess]:
    clock = {"use_sim_time": True} if lockstep else {}
    store = {"store": str(folder / "store")}
    mode = {"mode": "lockstep" if lockstep else "realtime"}
    return (
        NodeProcess("tcbi_sim", "sim_node", parameters={**mode, **store}),
        NodeProcess("tcbi_policy", "policy_node", parameters={**store, **clock, "policy": "gait:tripod"}),
    )


class Collection:
    """A goal of `collect_rollouts` and its answer."""

    def __init__(self, peer, **goal) -> None:
        self.peer, self.told = peer, []
        self._client = ActionClient(peer.node, CollectRollouts, names.COLLECT_ROLLOUTS)
        peer.wait_until(self._client.server_is_ready, "the recorder's action")
        sent = self._client.send_goal_async(
            CollectRollouts.Goal(**goal), feedback_callback=lambda m: self.told.append(m.feedback)
        )
        self.handle = peer.result(sent, "the answer to the goal")
        self._asked = [self.handle.get_result_async()] if self.handle.accepted else []

    def ended(self) -> bool:
        return any(future.done() for future in self._asked)

    def result(self):
        for _ in range(9):  # the middleware may lose a question or its answer
            if self.peer.comes(self.ended, 10.0):
                break
            self._asked.append(self.handle.get_result_async())
        assert self.ended(), "the end of the collection did not come"
        answer = next(future for future in self._asked if future.done()).result()
        return answer.status, answer.result
