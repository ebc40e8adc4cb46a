"""The demo's hands on the running graph: its actions and services, called one after the other.

with laboratory(domain_id) as lab:
    bag = lab.record("balance", "gait:steps", 1, folder)
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from tcbi_bringup.errors import DemoError
from tcbi_contract import names
from tcbi_contract.goals import SentGoal
from tcbi_msgs.action import CollectRollouts, Retrain
from tcbi_msgs.srv import LoadPolicy

APPEAR_S = 60.0  # for a node to appear
ANSWER_S = 30.0  # for a service to answer
ASK_AGAIN_S = 10.0  # for the end of a goal
POLL_S = 0.02

Feedback = Callable[[Any], None]


class LabNode(Node):
    """Calls `collect_rollouts`, `retrain` and `policy/load`."""

    def __init__(self, context: Context) -> None:
        super().__init__("lab_node", context=context)
        self._collect = ActionClient(self, CollectRollouts, names.COLLECT_ROLLOUTS)
        self._retrain = ActionClient(self, Retrain, names.RETRAIN)
        self._load = self.create_client(LoadPolicy, names.LOAD_POLICY)
        self._alive: Callable[[], None] = lambda: None

    def wait(self, alive: Callable[[], None]) -> None:
        """Wait until the graph's services are there.

        Args:
          alive: raises if a process has failed; called while waiting, now and for answers.
        """
        self._alive = alive
        for what, name in ((self._collect, names.COLLECT_ROLLOUTS), (self._load, names.LOAD_POLICY)):
            ready = what.server_is_ready if isinstance(what, ActionClient) else what.service_is_ready
            _until(ready, APPEAR_S, f"{name} did not appear within {APPEAR_S:.0f} s", alive)

    def record(
        self,
        task: str,
        policy: str,
        seed: int,
        folder: Path,
        *,
        duration_s: float = 0.0,
        slope: tuple[float, float] | None = None,
    ) -> Path:
        """Record a rollout and return its bag.

        Args:
          task: as registered.
          policy: a file, a name, or gait:<name>.
          seed: of the scenario.
          folder: where the bag goes.
          duration_s: of the rollout; 0 for the task's own.
          slope: roll and pitch of the ground, rad; drawn if None.

        Raises:
          DemoError: the recording failed, with the reason that the recorder gives.
        """
        goal = CollectRollouts.Goal(
            task=task, policy=policy, number=1, seed=seed, duration_s=duration_s, folder=str(folder)
        )
        if slope is not None:
            goal.slope_roll, goal.slope_pitch = [float(slope[0])], [float(slope[1])]
        result = self._do(self._collect, CollectRollouts, goal, None)
        if not result.success:
            raise DemoError(f"recording failed: {result.message}")
        return Path(result.bags[0])

    def retrain(self, task: str, model: str, budget_s: float, seed: int, feedback: Feedback | None = None) -> Any:
        """Train on draws of a model version, starting from the policy in use; the action's result.

        Raises:
          DemoError: the training failed.
        """
        goal = Retrain.Goal(task=task, model=model, budget_s=budget_s, seed=seed)
        _until(self._retrain.server_is_ready, APPEAR_S, f"{names.RETRAIN} did not appear within {APPEAR_S:.0f} s")
        result = self._do(self._retrain, Retrain, goal, feedback)
        if not result.success:
            raise DemoError(f"training failed: {result.message}")
        return result

    def load_policy(self, policy: str) -> str:
        """Swap the policy and return the id of the one now in use.

        Raises:
          DemoError: the policy node refuses it.
        """
        future = self._spun(lambda: self._load.call_async(LoadPolicy.Request(policy=policy)))
        _until(future.done, ANSWER_S, f"{names.LOAD_POLICY} did not answer")
        answer = future.result()
        if not answer.success:
            raise DemoError(f"the policy node refuses {policy}: {answer.message}")
        return answer.policy_id

    def _spun(self, call: Callable[[], Any]) -> Any:
        """Make a call in the spinning thread: an answer that comes before its request is noted would be dropped."""
        assert self.executor is not None
        task = self.executor.create_task(call)
        _until(task.done, ANSWER_S, "the lab node does not spin")
        return task.result()

    def _do(self, client: ActionClient, action: Any, goal: Any, feedback: Feedback | None) -> Any:
        heard = None if feedback is None else (lambda message: feedback(message.feedback))
        sent: SentGoal = self._spun(lambda: SentGoal(client, action, goal, *([heard] if heard else [])))
        deadline = time.monotonic() + ANSWER_S
        try:
            while sent.end is None:
                self._alive()
                if sent.refused:
                    raise DemoError("an action server refused its goal; is another one under way?")
                if not sent.taken and time.monotonic() > deadline:
                    raise DemoError("an action server did not answer")
                if sent.wants_asking(ASK_AGAIN_S):
                    self._spun(sent.ask)
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            cancelled = self._spun(sent.handle.cancel_goal_async)
            with contextlib.suppress(DemoError):
                _until(cancelled.done, 2.0, "no answer to a cancellation")
            raise
        return sent.end.result


def _until(
    condition: Callable[[], bool], patience_s: float, complaint: str, alive: Callable[[], None] = lambda: None
) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        alive()
        if time.monotonic() > deadline:
            raise DemoError(complaint)
        time.sleep(POLL_S)


@contextlib.contextmanager
def laboratory(domain_id: int) -> Iterator[LabNode]:
    """A lab node in a ROS domain of its own, spinning in a thread."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain_id)
    node = LabNode(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        executor.shutdown(timeout_sec=2.0)
        rclpy.try_shutdown(context=context)
        thread.join(timeout=3.0)
