"""The diagnose action: one diagnosis at a time in a worker process, with feedback and cancel; needs ROS."""

import time
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from tcbi_contract import messages, names
from tcbi_infer.inference_worker import Job
from tcbi_infer.messages import diagnosis_message, number
from tcbi_infer.worker_process import Worker
from tcbi_msgs.action import Diagnose
from tcbi_msgs.msg import Diagnosis

POLL_S = 0.1
ENDING_S = 6.0  # for a diagnosis to end with the node


class DiagnoseServer:
    """Serves diagnoses and publishes each, latched. A goal keeps the thread of its callback until it is done.

    Args:
      node: whose server this is.
      job: what a goal asks for; called in the thread of the goal.
      is_free: whether a goal may be accepted now.
      warn: gets each warning of the worker.
    """

    def __init__(
        self,
        node: Node,
        job: Callable[[Diagnose.Goal], Job],
        is_free: Callable[[], bool],
        warn: Callable[[str], None],
    ) -> None:
        self.runs = False
        self.rig = ""  # of the last diagnosis
        self._node, self._job, self._is_free, self._warn = node, job, is_free, warn
        self._closing = False
        self._diagnosis = node.create_publisher(Diagnosis, names.DIAGNOSIS, messages.LATCHED_QOS)
        self._server = ActionServer(
            node, Diagnose, names.DIAGNOSE, self._on_goal_accepted, callback_group=ReentrantCallbackGroup(),
            goal_callback=self._on_goal, cancel_callback=lambda _: CancelResponse.ACCEPT,
        )  # fmt: skip

    def leave(self) -> None:
        """End the diagnosis that runs, if one does; returns when it has ended, or after some seconds."""
        self._closing = True
        deadline = time.monotonic() + ENDING_S
        while self.runs and time.monotonic() < deadline:
            time.sleep(POLL_S)

    def _on_goal(self, goal: Diagnose.Goal) -> GoalResponse:
        if self.runs or not self._is_free():
            self._node.get_logger().warning("diagnose refused: the worker is busy; try again when it is done")
            return GoalResponse.REJECT
        self.runs = True
        return GoalResponse.ACCEPT

    def _on_goal_accepted(self, handle: ServerGoalHandle) -> Diagnose.Result:
        try:
            return self._diagnosed(handle)
        finally:
            self.runs = False

    def _diagnosed(self, handle: ServerGoalHandle) -> Diagnose.Result:
        worker = Worker(self._job(handle.request))
        result, finished = Diagnose.Result(message="cancelled"), False
        try:
            while not (finished or handle.is_cancel_requested or self._closing):
                finished = any([self._on_news(handle, event, result) for event in worker.events()])
                time.sleep(POLL_S)
        finally:
            worker.stop()
        if result.success:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return result

    def _on_news(self, handle: ServerGoalHandle, event: dict[str, Any], result: Diagnose.Result) -> bool:
        """Pass one event of the worker on; whether it was the last."""
        kind = event.pop("event")
        if kind == "progress":
            remaining = number(event["remaining_s"])
            handle.publish_feedback(
                Diagnose.Feedback(stage=event["stage"], fraction=float(event["share"]), remaining_s=remaining)
            )
        elif kind == "warning":
            self._warn(event["message"])
        elif kind == "diagnosis":
            result.diagnosis = diagnosis_message(event, self._node.get_clock().now().to_msg())
            result.message = result.diagnosis.statement
            self._diagnosis.publish(result.diagnosis)
            self.rig = result.diagnosis.model.rpartition("-v")[0]
        else:
            result.success = kind == "done"
            result.message = event.get("message", result.message)
        return kind in ("done", "failed")
