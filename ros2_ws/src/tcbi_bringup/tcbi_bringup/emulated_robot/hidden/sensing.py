"""What the sensors get wrong: readings that are old, an IMU askew, a gyroscope that drifts."""

import math

import numpy as np

from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.mechanics import Build
from tcbi_bringup.emulated_robot.sensors import POLL_TICKS
from tcbi_bringup.emulated_robot.servos import LOOP_PERIOD_S


class StaleReadings(HiddenEffect):
    """A board that polls its sensors into a queue: what is sent and stamped now was read some turns ago."""

    strong, weak = 0.025, 0.008  # s

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        waiting = (POLL_TICKS - 1) / 2  # for the next turn, on average
        self.polls_behind = max(round((self.size / LOOP_PERIOD_S - waiting) / POLL_TICKS), 1)
        self.truth = {"latency_s": (self.polls_behind * POLL_TICKS + waiting) * LOOP_PERIOD_S}


class AskewBoard(HiddenEffect):
    """An IMU glued a little askew: gyroscope and accelerometer turn with it, and so does the fusion's attitude."""

    strong, weak = 0.07, 0.025  # rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        angle = rng.uniform(-math.pi, math.pi)
        self._tilt = (self.size * math.cos(angle), self.size * math.sin(angle))
        self.truth = {"roll_rad": self._tilt[0], "pitch_rad": self._tilt[1]}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.imu_tilt = self._tilt


class BiasedGyro(HiddenEffect):
    """A gyroscope whose registers do not read zero at rest, and drift while the chip warms up.

    The chip's fusion knows its bias; who reads the registers does not.
    """

    strong, weak = 0.06, 0.025  # rad/s, length of the bias

    WARMING, WARMING_TIME_S = 0.1, 20.0  # of the bias, added as the chip warms up

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        direction = rng.normal(size=3)
        self._bias = self.size * direction / np.linalg.norm(direction)
        self.truth = {f"{axis}_rad_s": float(value) for axis, value in zip("xyz", self._bias, strict=True)}

    def gyro(self, rate: np.ndarray, time: float) -> np.ndarray:
        return rate + self._bias * (1.0 - self.WARMING * math.exp(-time / self.WARMING_TIME_S))
