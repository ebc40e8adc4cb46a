"""A goal sent to an action server, whose end can be asked for even where an answer is lost on the way; needs ROS.

    sent = SentGoal(client, Retrain, goal, on_feedback)
    while not (sent.refused or sent.end):
        if sent.wants_asking(10.0):
            sent.ask()
        executor.spin_once(0.1)

A server may lose its answer to a client that it has not discovered yet. So the goal bears an id of its own from the
start, and everything but the goal itself may be asked again. All calls belong into the thread that spins the client.
"""

import time
import uuid
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle


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
        self._on_feedback, self._told = on_feedback, False
        self._ends: list[Any] = []
        goal_id = action.Impl.SendGoalService.Request().goal_id
        goal_id.uuid = list(uuid.uuid4().bytes)
        self.handle = ClientGoalHandle(client, goal_id, action.Impl.SendGoalService.Response(accepted=True))
        self._answer = client.send_goal_async(goal, feedback_callback=self._hear, goal_uuid=goal_id)

    @property
    def end(self) -> Any | None:
        """Status and result; None while it runs. The status is UNKNOWN where the server knows no such goal."""
        return next((future.result() for future in self._ends if future.done()), None)

    @property
    def taken(self) -> bool:
        """Whether the server has taken it."""
        known = self.end is not None and self.end.status != GoalStatus.STATUS_UNKNOWN
        return known or self._told or bool(self._answer.done() and self._answer.result().accepted)

    @property
    def refused(self) -> bool:
        """Whether the server has not taken it."""
        if self._answer.done():
            return not self._answer.result().accepted
        return self.end is not None and not self.taken

    def wants_asking(self, patience_s: float) -> bool:
        """Whether its end should be asked for: not done yet though it was taken, or nothing heard for so long."""
        return (self.taken and not self._ends) or time.monotonic() - self.heard_s > patience_s

    def ask(self) -> None:
        """Ask for its end."""
        self._ends.append(self.handle.get_result_async())
        self.heard_s = time.monotonic()

    def _hear(self, message: Any) -> None:
        self._told, self.heard_s = True, time.monotonic()
        self._on_feedback(message)
