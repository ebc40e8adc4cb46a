"""The action `retrain`: trains in a subprocess while the graph goes on, and swaps a better policy in."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import String

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_msgs.action import Retrain
from tcbi_msgs.srv import LoadPolicy
from tcbi_policy.retraining import Event, Job, Outcome, reference_of, retrain, rival_for
from tcbi_policy.runs import TrainingProcess
from tcbi_sim.store import LATEST, default_root

PATIENCE_S, POLL_S = 5.0, 0.05  # with the policy node
SWAP_PATIENCE_S = 30.0  # a machine that has trained until now is busy, and nothing but this answer is missing
# after a training: just then the robot tries the new policy, and has no processor to spare; or after a failed start
STAND_BY_AGAIN_S = 60.0
ENDING_S, ENDING_POLL_S = 4.0, 0.1  # for a training to end with the node


@dataclass(frozen=True)
class RetrainParameters:
    """Parameters of the retrain node."""

    store: str = parameter("", "folder of the store; empty for ~/.local/share/tcbi")
    threads: int = parameter(0, "processors for the physics; 0 for all", low=0, high=256)
    fallback_policy: str = parameter("gait:stand", "what a new policy must beat while no policy node runs")
    stand_by: bool = parameter(True, "keep a process with all libraries loaded: 0.4 GB, and trainings begin 7 s sooner")


class RetrainNode(Node):
    """One training at a time; the action runs in a thread of the executor."""

    def __init__(self) -> None:
        super().__init__("retrain_node")
        self.values = declare(self, RetrainParameters)
        self._store = Path(self.values.store).expanduser() if self.values.store else default_root()
        self._busy = self._closing = False
        self._accepting = threading.Lock()  # goals come in several threads
        self._in_use = ""  # id of the policy or gait
        self._state: dict[str, Any] = {"state": "idle"}
        self._waiting: TrainingProcess | None = None
        self._stand_by_from_s = 0.0  # on the steady clock
        self._stand_by()
        training, rest = ReentrantCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, messages.STREAM_QOS)
        self.create_subscription(
            String, names.POLICY_STATUS, self._on_policy, messages.LATCHED_QOS, callback_group=rest
        )
        self._load = self.create_client(LoadPolicy, names.LOAD_POLICY, callback_group=rest)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=steady, callback_group=rest)
        self._server = ActionServer(
            self, Retrain, names.RETRAIN, self._execute, callback_group=training,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel,
        )  # fmt: skip

    def _on_policy(self, message: String) -> None:
        self._in_use = message.data

    def _on_goal(self, goal: Retrain.Goal) -> GoalResponse:
        with self._accepting:
            if self._busy:
                self.get_logger().warning("a training is running; cancel it first")
                return GoalResponse.REJECT
            self._busy = True
            return GoalResponse.ACCEPT

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        return CancelResponse.ACCEPT

    def _execute(self, handle: ServerGoalHandle) -> Retrain.Result:
        result = Retrain.Result(return_before=math.nan, return_after=math.nan)
        try:
            in_use = self._in_use_now(handle)
            job = self._job(handle.request, in_use)
            self.get_logger().info(f"training for {job.task} on model {job.model}, against {job.current}")
            outcome = retrain(
                job,
                lambda event: self._on_event(handle, event),
                lambda: bool(handle.is_cancel_requested) or self._closing,
                self._process,
            )
            self._finish(handle, result, outcome, job.task, in_use)
        except (TcbiError, OSError) as error:  # OSError: a full disk, no memory for the process
            result.message = str(error)
            self.get_logger().error(result.message)
            handle.abort()
        finally:
            self._stand_by_from_s = time.monotonic() + STAND_BY_AGAIN_S
            self._busy = False
            self._state = {"state": "idle", "last": result.message}
        return result

    def _stand_by(self) -> None:
        """Have a process stand by where one is wanted and none does; one that cannot be started is tried again."""
        rested = time.monotonic() >= self._stand_by_from_s
        if not (self.values.stand_by and self._waiting is None and rested) or self._busy or self._closing:
            return
        try:
            self._waiting = TrainingProcess()
        except OSError as error:
            self._stand_by_from_s = time.monotonic() + STAND_BY_AGAIN_S
            self.get_logger().warning(f"no process stands by, trainings begin later: {error}", once=True)

    def _process(self) -> TrainingProcess:
        """The process that stands by, or a new one if none does or it has died."""
        process, self._waiting = self._waiting, None
        if process is not None and process.running:
            return process
        if process is not None:
            process.close()
        return TrainingProcess()

    def leave(self) -> None:
        """End the training and the process that stands by; the training goes on when asked for again."""
        self._closing = True
        deadline = time.monotonic() + ENDING_S
        while self._busy and time.monotonic() < deadline:
            time.sleep(ENDING_POLL_S)
        if self._waiting is not None:
            self._waiting.close()

    def _in_use_now(self, handle: ServerGoalHandle) -> str:
        """Id of the policy in use, or back in use after a recording; "" while no policy node runs."""
        if not self._load.service_is_ready():
            return self._in_use
        answer = self._load.call_async(LoadPolicy.Request())
        if not self._comes(handle, answer.done):
            return self._in_use
        response = answer.result()
        return str(response.lender or response.policy_id)

    def _job(self, goal: Retrain.Goal, in_use: str) -> Job:
        standing = reference_of(in_use, self._store) if in_use else self.values.fallback_policy
        rival = rival_for(goal.task, standing, self._store)
        return Job(
            task=goal.task, current=rival, start=goal.policy, model=goal.model or LATEST, store=self._store,
            budget_s=goal.budget_s, budget_steps=goal.budget_steps, seed=goal.seed, threads=self.values.threads,
        )  # fmt: skip

    def _on_event(self, handle: ServerGoalHandle, event: Event) -> None:
        if event["event"] in ("progress", "done"):
            steps, found = int(event["steps"]), event["mean_return"]
            mean_return = math.nan if found is None else float(found)
            known = event.get("remaining_s", 0.0)
            remaining_s = math.nan if known is None else float(known)
            handle.publish_feedback(Retrain.Feedback(steps=steps, mean_return=mean_return, remaining_s=remaining_s))
            self._state = {
                "state": "training",
                "steps": steps,
                "mean return": f"{mean_return:.0f}",
                "remaining (s)": "not known yet" if known is None else f"{remaining_s:.0f}",
            }
        elif event["event"] == "comparing":
            self._state = {"state": "comparing", "rival": event["rival"], "held-out rollouts": str(event["pairs"])}
            self.get_logger().info(f"trained; comparing with {event['rival']} on {event['pairs']} held-out rollouts")
        elif event["event"] in ("resumed", "restarted"):
            self.get_logger().warning(f"training {event['event']}: {event.get('reason', 'from its last checkpoint')}")

    def _finish(
        self, handle: ServerGoalHandle, result: Retrain.Result, outcome: Outcome, task: str, in_use: str
    ) -> None:
        result.accepted, result.policy, result.message = outcome.accepted, outcome.path, outcome.message
        result.return_before, result.return_after = outcome.return_before, outcome.return_after
        if outcome.cancelled:
            handle.canceled() if handle.is_cancel_requested else handle.abort()
            return
        result.success = True
        if outcome.accepted:
            result.message += f"; {self._swap(handle, outcome, task, in_use)}"
        self.get_logger().info(result.message)
        handle.succeed()

    def _swap(self, handle: ServerGoalHandle, outcome: Outcome, task: str, in_use: str) -> str:
        """Ask the policy node to have it take its rival's place; what came of it, in words.

        Who cancels after the comparison has a verdict, but no other policy on the robot.
        """
        reference = outcome.reference
        there = self._comes(handle, self._load.service_is_ready)
        if handle.is_cancel_requested:
            return f"kept as {reference}, not loaded: cancelled after the comparison"
        if not there:
            return f"kept as {reference}: no policy node runs that could take it"
        if in_use not in ("", outcome.rival):
            return f"kept as {reference}: {in_use}, which is in use, is no policy for {task}"
        answer = self._load.call_async(LoadPolicy.Request(policy=reference, replaces=outcome.rival))
        if not self._comes(handle, answer.done, SWAP_PATIENCE_S):
            cancelled = ", cancelled while it was asked to take it" if handle.is_cancel_requested else ""
            return f"kept as {reference}: the policy node did not answer{cancelled}"
        response = answer.result()
        if not response.success:
            return f"kept as {reference}: {response.message}"
        if response.lender:
            return f"kept as {reference}: it takes over when the recording with {response.policy_id} ends"
        return f"now in use as {response.policy_id}"

    def _comes(self, handle: ServerGoalHandle, there: Callable[[], bool], patience_s: float = PATIENCE_S) -> bool:
        """Whether something is there in time; who cancels does not wait for it."""
        deadline = time.monotonic() + patience_s
        while not (found := there()) and time.monotonic() < deadline and not handle.is_cancel_requested:
            time.sleep(POLL_S)
        return found

    def _diagnose(self) -> None:
        self._stand_by()
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="retrain_node", message=str(self._state["state"]))
        status.values = [KeyValue(key=key, value=str(value)) for key, value in self._state.items() if key != "state"]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("retrain_node", RetrainNode, args, threads=4)
