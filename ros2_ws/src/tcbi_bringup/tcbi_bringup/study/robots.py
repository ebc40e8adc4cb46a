"""Rollouts on emulated robots, several at a time in processes of their own.

with Laboratory(workers=2) as laboratory:
    measurements = laboratory.run([Order(11, "strong", scenario, policy.path, sigma=0.0, trial=3), ...])
"""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
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


def _end_with_parent() -> None:
    """End this worker when its parent is killed; the pool's own workers would wait for orders for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C waits meanwhile, and processes that are started here never hear of it: their parent ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Laboratory:
    """Processes in which robots move; with one worker they move in this one."""

    def __init__(self, workers: int):
        self._workers = workers
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor | None:
        if self._workers < 2:
            return None
        return ProcessPoolExecutor(self._workers, multiprocessing.get_context("spawn"), _end_with_parent)

    def run(self, orders: Sequence[Order]) -> list[Measurement]:
        """All orders, in their order.

        Raises:
          BrokenProcessPool: a process died, for want of memory perhaps; the next call has new ones.
        """
        try:
            if not self._pool:
                return [done(order) for order in orders]
            with _interrupts_held():  # the pool starts its processes here
                results = [self._pool.submit(done, order) for order in orders]
            return [result.result() for result in results]
        except BrokenProcessPool:
            self._pool = self._new_pool()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._pool:
            return
        if kind is not None:  # what the rollouts at work would say is lost anyway
            for worker in multiprocessing.active_children():
                worker.terminate()
        self._pool.shutdown(cancel_futures=True)
