"""Asks a graph's recorder for rollouts, from a program that is no node itself; needs ROS.

    with CollectClient(domain_id=0) as client:
        result, succeeded = client.collect(Request("balance", 5, seed=1))

Ctrl-C while it waits, or SIGTERM, cancels the goal: the rollout that runs is aborted, those before it stay. One that is
over and waits for its distance is kept without it.
"""

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64

from tcbi_contract import messages, names
from tcbi_contract.goals import SentGoal
from tcbi_infer.collection import Request
from tcbi_infer.collection_messages import goal_of
from tcbi_infer.errors import RecordingError
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.srv import ResetEpisode

CANCEL_S = 15.0
GONE_S = 10.0  # without the recorder, until it is given up
ASK_AGAIN_S = 10.0  # for the end of a goal


class CollectClient:
    """A client of `collect_rollouts`; a context manager.

    Attributes:
      on_progress: called with the rollouts done, the present rollout's id, and its seconds left.
      on_distance: called with a rollout's id once it is over; what it returns (m) is sent as `rollout/distance`.
      while_waiting: called again and again until the recorder has taken the goal; raises if waiting is in vain.
    """

    def __init__(self, domain_id: int | None = None, namespace: str = "") -> None:
        self.on_progress: Callable[[int, str, float], None] = lambda *_: None
        self.on_distance: Callable[[str], float] | None = None
        self.while_waiting: Callable[[], None] = lambda: None
        self._on_place: Callable[[Any], None] | None = None
        self._asked: set[str] = set()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node(
            "collect_client", context=self._context, namespace=namespace.strip("/") or None, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._client = ActionClient(self._node, CollectRollouts, names.COLLECT_ROLLOUTS)
        self._distance = self._node.create_publisher(Float64, names.DISTANCE, messages.STREAM_QOS)

    def offer_place(self, on_place: Callable[[Any], None]) -> None:
        """Place the robot before each rollout: `on_place` gets slopes (rad) and blocks, and returns when it is done."""
        self._on_place = on_place
        self._node.create_service(ResetEpisode, names.PLACE_ROBOT, self._place)

    def _place(self, request: ResetEpisode.Request, response: ResetEpisode.Response) -> ResetEpisode.Response:
        assert self._on_place is not None
        self._on_place(request)
        response.success = True
        return response

    def collect(self, request: Request, ready_s: float = 40.0) -> tuple[Any, bool]:
        """Wait for the recorder, send the goal, wait for its end; returns the result and whether all went well.

        Raises:
          RecordingError: there is no recorder, it is busy, it has gone, or it was restarted.
        """
        if not self._until(self._client.server_is_ready, ready_s, self.while_waiting):
            raise RecordingError(
                f"nobody offers {names.COLLECT_ROLLOUTS} after {ready_s:g} s; start the graph (./tcbi up), "
                "or let --robot start one"
            )
        sent = SentGoal(self._client, CollectRollouts, goal_of(request), self._on_feedback)
        try:
            ended = self._end(sent, ready_s)
        except KeyboardInterrupt:
            ended = self._cancelled(sent)
            if ended is None:
                raise
        except BaseException:  # the signal to end, or the graph has failed: nobody would take the rollouts any more
            self._cancelled(sent)
            raise
        if ended.status == GoalStatus.STATUS_UNKNOWN:
            raise RecordingError(
                "the recorder was restarted meanwhile and knows nothing of this collection; finished rollouts lie in "
                f"{request.folder or 'its folder'}; look at the log of recorder_node"
            )
        return ended.result, ended.status == GoalStatus.STATUS_SUCCEEDED

    def _end(self, sent: SentGoal, ready_s: float) -> Any:
        """Wait until a goal is taken, at most `ready_s`, and for its end."""
        watch, deadline = self._recorder_watch(), time.monotonic() + ready_s
        while sent.end is None:
            if sent.refused:
                raise RecordingError("the recorder is busy with another rollout; wait for its end, or cancel it")
            if not sent.taken and time.monotonic() > deadline:
                raise RecordingError(
                    f"the recorder did not answer within {ready_s:g} s; look at the log of recorder_node"
                )
            if sent.wants_asking(ASK_AGAIN_S):
                sent.ask()
            (watch if sent.taken else self.while_waiting)()
            self._executor.spin_once(timeout_sec=0.1)
        return sent.end

    def _cancelled(self, sent: SentGoal) -> Any | None:
        """Take a goal back, and wait until its rollout is closed; its end, or None if it does not come in time."""
        if sent.refused or not self._client.server_is_ready():
            return None
        sent.handle.cancel_goal_async()
        sent.ask()
        return sent.end if self._until(lambda: sent.end is not None, CANCEL_S) else None

    def _recorder_watch(self) -> Callable[[], None]:
        """What raises once the recorder has been away for GONE_S."""
        seen = time.monotonic()

        def watch() -> None:
            nonlocal seen
            if self._client.server_is_ready():
                seen = time.monotonic()
            elif time.monotonic() - seen > GONE_S:
                raise RecordingError(
                    f"the recorder has gone for {GONE_S:g} s; its finished rollouts are kept, a cut-off one is for "
                    "./tcbi recover; look at the log of recorder_node"
                )

        return watch

    def _until(
        self,
        condition: Callable[[], bool],
        timeout_s: float = float("inf"),
        while_waiting: Callable[[], None] = lambda: None,
    ) -> bool:
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            while_waiting()
            self._executor.spin_once(timeout_sec=0.1)
        return True

    def _on_feedback(self, message: Any) -> None:
        feedback = message.feedback
        self.on_progress(int(feedback.done), feedback.rollout_id, float(feedback.remaining_s))
        if self.on_distance and feedback.remaining_s <= 0 and feedback.rollout_id not in self._asked:
            self._asked.add(feedback.rollout_id)
            self._distance.publish(Float64(data=self.on_distance(feedback.rollout_id)))

    def __enter__(self) -> "CollectClient":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)
