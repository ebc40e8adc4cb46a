"""A goal sent to an action server, whose end can be asked for even where an answer is lost on the way; needs ROS.

    sent = SentGoal(client, Retrain, goal, on_feedback)
    while not (sent.refused or sent.end):
        if sent.wants_asking(10.0):
            sent.ask()
        executor.spin_once(0.1)

A server may lose its answer to a client that it has not discovered yet, and may hear of a goal later than of the
question for its end, since each has a service of its own. So the goal bears an id of its own from the start, and
everything may be asked again: a server takes an id once. All calls belong into the thread that spins the client.
"""

import time
import uuid
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle

UNKNOWN_TIMES = 3  # so often must a server say that it knows no such goal, before it counts as refused


class SentGoal:
    """A goal, until its end is known.

    Args:
      client: whose server is there.
      action: the type of the action.
      goal: of that action.
      on_feedback: gets each feedback message.

    Attributes:
      goal: what was asked for.
      handle: to cancel it with.
      heard_s: when its server told of it, or was last asked, on the steady clock.
    """

    def __init__(
        self, client: ActionClient, action: Any, goal: Any, on_feedback: Callable[[Any], None] = lambda message: None
    ) -> None:
        self.goal = goal
        self.heard_s = time.monotonic()
        self._client, self._on_feedback, self._told = client, on_feedback, False
        self._answers: list[Any] = []
        self._ends: list[Any] = []
        self._before = 0  # so many of these were asked for before the goal was known to be taken
        self._id = action.Impl.SendGoalService.Request().goal_id
        self._id.uuid = list(uuid.uuid4().bytes)
        self.handle = ClientGoalHandle(client, self._id, action.Impl.SendGoalService.Response(accepted=True))
        self._send()

    @property
    def end(self) -> Any | None:
        """Status and result; None while it runs. The status is UNKNOWN where the server knows no such goal."""
        heard = self._heard(self._ends)
        known = [e for e in heard if e.status != GoalStatus.STATUS_UNKNOWN]
        if known:
            return known[0]
        unknown = self._heard(self._ends[self._before :]) if self._accepted else heard[UNKNOWN_TIMES - 1 :]
        return unknown[0] if unknown else None

    @property
    def taken(self) -> bool:
        """Whether the server has taken it."""
        return self._accepted or any(e.status != GoalStatus.STATUS_UNKNOWN for e in self._heard(self._ends))

    @property
    def refused(self) -> bool:
        """Whether the server has not taken it."""
        first = self._answers[0]
        return not self.taken and (first.done() or self.end is not None)

    def wants_asking(self, patience_s: float) -> bool:
        """Whether its end should be asked for: not done yet though it was taken, or nothing heard for so long."""
        return (self.taken and len(self._ends) == self._before) or time.monotonic() - self.heard_s > patience_s

    def ask(self) -> None:
        """Ask for its end; a goal that the server said it does not know is sent again."""
        if not self.taken:
            if self._heard(self._ends):
                self._send()
            self._before = len(self._ends) + 1
        self._ends.append(self.handle.get_result_async())
        self.heard_s = time.monotonic()

    @property
    def _accepted(self) -> bool:
        return self._told or any(answer.accepted for answer in self._heard(self._answers))

    @staticmethod
    def _heard(futures: list[Any]) -> list[Any]:
        return [future.result() for future in futures if future.done()]

    def _send(self) -> None:
        self._answers.append(self._client.send_goal_async(self.goal, feedback_callback=self._hear, goal_uuid=self._id))

    def _hear(self, message: Any) -> None:
        self._told, self.heard_s = True, time.monotonic()
        self._on_feedback(message)
