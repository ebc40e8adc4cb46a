"""The physics in real time, as the firmware's body.

The robot's clock follows the steady clock. Where the machine is too slow for that, the robot's clock loses time and
says so: a motion is never skipped, and nobody mistakes a slow machine for a slow robot.
"""

import logging
import threading
import time
from collections.abc import Callable

import numpy as np

from tcbi_bringup.emulated_robot.body import BodyState
from tcbi_bringup.emulated_robot.mechanics import Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen

_log = logging.getLogger(__name__)

CHUNK_S = 0.004  # of motion between two looks at the steady clock
PATIENCE_S = 0.05  # greatest time that one call spends on catching up
SLACK_S = 0.1  # lag beyond which the robot's clock gives up catching up
REPORT_PERIOD_S = 2.0

BATTERY_V = 7.8
LINE_DROP_V = 0.9  # with all servos at full torque
AMBIENT_C = 25.0
HEATING_C = 45.0  # above ambient, at full torque for ever
HEATING_TIME_S = 240.0


class LiveBody:
    """A specimen that lives on the steady clock; every method may be called from any thread.

    Args:
      specimen: which robot.
      trial: draws the noise; see `Physics`.
      clock: a steady clock in s.

    Attributes:
      lost_s: time that the robot's clock has lost because the machine was too slow.
    """

    def __init__(self, specimen: Specimen, trial: int = 0, clock: Callable[[], float] = time.monotonic):
        self._physics = Physics(specimen, trial)
        self._clock, self._lock = clock, threading.RLock()
        self._begin = clock() - self._physics.time
        self.lost_s = 0.0
        self._reported = (clock(), 0.0)
        self._temperature = np.full(len(self._physics.servos.on), AMBIENT_C)
        self._heated_until = self._physics.time

    def write_goal(self, servo_index: int, goal_rad: float, duration_s: float, speed_rad_s: float = 0.0) -> None:
        """Move one joint from its last commanded position; see `Body`."""
        with self._lock:
            self._catch_up()
            self._physics.send_each([(servo_index, goal_rad)], duration_s, speed_rad_s)

    def set_torque(self, servo_index: int, on: bool) -> None:
        """Switch one servo's torque; see `Body`."""
        with self._lock:
            self._catch_up()
            self._physics.switch(servo_index, on)

    def read(self) -> BodyState:
        """The sensors, now."""
        with self._lock:
            self._catch_up()
            sample = self._physics.read()
            self._heat(sample.load)
            w, x, y, z = sample.attitude
            return BodyState(
                time_s=sample.time,
                joint_position=sample.joint_position,
                voltage=BATTERY_V * self._physics.supply() - LINE_DROP_V * float(np.abs(sample.load).mean()),
                temperature=self._temperature + self._physics.warmth(),
                load=sample.load,
                attitude=np.array([x, y, z, w]),
                angular_velocity=sample.angular_velocity,
                linear_acceleration=sample.linear_acceleration,
                contact=sample.contact,
            )

    def place(self, scene: Scene) -> None:
        """The experimenter's hands: set up the ground and put the robot, in its present posture, at the origin."""
        with self._lock:
            self._catch_up()
            self._physics.place(scene)

    def pose(self) -> tuple[float, np.ndarray, np.ndarray]:
        """What an ideal tracker sees: robot time (s), position (3,) m, orientation (4,) w x y z, base in world."""
        with self._lock:
            self._catch_up()
            return self._physics.time, self._physics.true_position(), self._physics.true_attitude()

    def stop(self) -> None:
        """Stand still for good: a thread that still asks waits, instead of stepping physics while the process ends."""
        self._lock.acquire()

    def _catch_up(self) -> None:
        physics, started = self._physics, self._clock()
        while (present := self._clock()) - self._begin > physics.time and present - started < PATIENCE_S:
            physics.advance_to(min(present - self._begin, physics.time + CHUNK_S))
            if present - self._begin - physics.time < CHUNK_S / 4:
                break
        behind = self._clock() - self._begin - physics.time
        if behind > SLACK_S:
            self._begin += behind
            self.lost_s += behind
        self._report()

    def _report(self) -> None:
        then, lost = self._reported
        now = self._clock()
        if self.lost_s > lost and now - then >= REPORT_PERIOD_S:
            share = 1.0 - (self.lost_s - lost) / (now - then)
            _log.warning(
                "the machine is too slow for the emulated robot: its clock runs at %.0f %% of real time "
                "(%.1f s lost so far); stop other programs or record fewer things at once",
                100 * max(share, 0.0),
                self.lost_s,
            )
            self._reported = (now, self.lost_s)
        elif now - then >= REPORT_PERIOD_S:
            self._reported = (now, self.lost_s)

    def _heat(self, load: np.ndarray) -> None:
        now = self._physics.time
        share = min((now - self._heated_until) / HEATING_TIME_S, 1.0)
        self._heated_until = now
        self._temperature += share * (AMBIENT_C + HEATING_C * np.square(load) - self._temperature)
