"""Rollouts on emulated robots, several at a time in processes of their own.

with Laboratory(workers=2) as laboratory:
    measurements = laboratory.run([Order(11, "strong", scenario, policy.path, sigma=0.0, trial=3), ...])
"""

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from tcbi_bringup.emulated_robot.as_measurement import measure
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_policy.artefact import Actor, find_policy
from tcbi_policy.evaluation import NoisyObservation
from tcbi_sim.measurement import Measurement, Scenario


@dataclass(frozen=True)
class Order:
    """One rollout.

    Attributes:
      robot: its number.
      strength: of what is hidden in it.
      scenario: what it is asked to do.
      policy: a reference.
      trial: numbers the repeats; each has its own sensor noise and bus jitter.
      sigma: rad, further noise on what the policy sees.
    """

    robot: int
    strength: str
    scenario: Scenario
    policy: str
    trial: int
    sigma: float = 0.0


def done(order: Order) -> Measurement:
    """Run one order."""
    actor: Actor = find_policy(order.policy)
    if order.sigma:
        actor = NoisyObservation(actor, order.sigma)
    robot = EmulatedRobot(order.robot, None, order.strength)
    return measure(robot, order.scenario, actor, trial=order.trial, policy_id=actor.policy_id)


class Laboratory:
    """Processes in which robots move; with one worker they move in this one."""

    def __init__(self, workers: int):
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, mp_context=spawn) if workers > 1 else None

    def run(self, orders: Sequence[Order]) -> list[Measurement]:
        """All orders, in their order."""
        return list(self._pool.map(done, orders) if self._pool else map(done, orders))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
