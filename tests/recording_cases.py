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
        self.sent = peer.send(
            self._client, CollectRollouts, CollectRollouts.Goal(**goal), lambda m: self.told.append(m.feedback)
        )

    def ended(self) -> bool:
        return self.sent.end is not None

    def result(self):
        answer = self.peer.end(self.sent, "the end of the collection")
        return answer.status, answer.result
