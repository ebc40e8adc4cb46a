"""Asks the retrain server for a new policy when it is worth one, and follows the training to its end; needs ROS."""

import time
from collections.abc import Mapping
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from tcbi_contract import names
from tcbi_contract.goals import SentGoal
from tcbi_msgs.action import Retrain

BUSY_S = 10.0  # before a busy retrain server is asked again
FOLLOW_S = 0.5  # between two looks at a training
ASK_AGAIN_S = 4.0  # without feedback, for a training's end
GONE_S = 5.0  # without the retrain server, until its training is given up


class TrainingClient:
    """At most one training that runs, and one wish for the next; a later wish takes the place of an earlier one.

    Args:
      node: whose client this is.
      values: the node's parameters `posterior_moved`, `error_fell`, `retrain_budget_s` and `seed`.
      trained_on: model version that the policy in use was trained on.
      group: of all callbacks.
    """

    def __init__(self, node: Node, values: Any, trained_on: str, group: CallbackGroup) -> None:
        self.trained_on = trained_on
        self._values, self._log = values, node.get_logger()
        self._client = ActionClient(node, Retrain, names.RETRAIN, callback_group=group)
        self._training: SentGoal | None = None
        self._wish: Retrain.Goal | None = None
        self._served = 0.0  # s of the steady clock, when the retrain server was last there
        self._ask_after = 0.0  # s of the steady clock
        node.create_timer(
            FOLLOW_S, self._see_to_it, clock=Clock(clock_type=ClockType.STEADY_TIME), callback_group=group
        )

    @property
    def runs(self) -> bool:
        """Whether a training runs."""
        return self._training is not None

    @property
    def is_wanted(self) -> bool:
        """Whether one is wished for and not begun."""
        return self._wish is not None

    def consider(self, posterior: Mapping[str, Any], before: float, after: float) -> None:
        """Wish for a training if the posterior moved, or the error fell, by as much as the parameters say.

        Args:
          posterior: the worker's event of this kind.
          before: error over the noise floor on held-out rollouts of the version trained on; NaN if unknown.
          after: that of the posterior's version.
        """
        fall, why = 1 - after / before, []
        if posterior["moved"] >= self._values.posterior_moved:
            why.append(f"the posterior moved by {posterior['moved']:.2g} standard deviations")
        if fall >= self._values.error_fell:
            why.append(f"the error on held-out rollouts fell by {fall:.0%}")
        if not why:
            return
        if "+" in posterior["task"]:
            self._log.warning(f"{' and '.join(why)}, but no training is asked for: rollouts of several tasks")
            return
        self._wish = Retrain.Goal(task=posterior["task"], model=posterior["model"], seed=self._values.seed)
        self._wish.budget_s = self._values.retrain_budget_s
        self._log.info(f"wants a training on {self._wish.model}: {' and '.join(why)}")
        if not self._client.server_is_ready():
            self._log.warning("no retrain server runs; it is asked as soon as one does")

    def _see_to_it(self) -> None:
        """Follow the training that runs; without one, send the last wish once a server is there."""
        if self._training is not None:
            self._follow(self._training)
        elif self._wish is not None and time.monotonic() >= self._ask_after and self._client.server_is_ready():
            goal, self._wish = self._wish, None
            self._log.info(f"asks for a training on {goal.model}")
            self._training, self._served = SentGoal(self._client, Retrain, goal), time.monotonic()

    def _follow(self, training: SentGoal) -> None:
        """Take a training's end, or notice that its server has been started anew, or has gone."""
        now, model = time.monotonic(), training.goal.model
        if self._client.server_is_ready():
            self._served = now
        if training.end is not None and training.end.status == GoalStatus.STATUS_UNKNOWN:
            self._wish_again(training, f"the retrain server knows no training on {model}; asked again")
        elif training.refused:
            self._ask_after = now + BUSY_S
            self._wish_again(training, f"the retrain server is busy; asked again in {BUSY_S:.0f} s")
        elif training.end is not None:
            self._end(model, training.end.result)
        elif now - self._served > GONE_S:
            self._wish_again(training, "the retrain server has gone; it is asked again as soon as it is back")
        elif training.wants_asking(ASK_AGAIN_S):
            training.ask()

    def _wish_again(self, training: SentGoal, why: str) -> None:
        """Give a training up; the same goal goes on from its last checkpoint, unless there is a later wish."""
        self._training, self._wish = None, self._wish or training.goal
        self._log.warning(why)

    def _end(self, model: str, result: Retrain.Result) -> None:
        self._training = None
        if result.success:
            self.trained_on = model
        self._log.info(f"training on {model}: {result.message}")
