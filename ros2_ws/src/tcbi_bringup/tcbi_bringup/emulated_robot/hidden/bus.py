"""What happens to goals between the sender and the servos: they wait, get lost, or are too small to be heard."""

import math

import numpy as np

from tcbi_bringup.emulated_robot.character import JOINT_COUNT
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect


class BusDelay(HiddenEffect):
    """Packets of goals wait on a shared radio link, each a little longer or shorter; none overtakes another."""

    strong, weak = 0.070, 0.030  # s, mean

    JITTER = 0.15  # standard deviation over mean

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"latency_s": self.size, "jitter_s": self.size * self.JITTER}

    def bus_delay(self, rng: np.random.Generator) -> float:
        shape = self.JITTER**-2
        return float(rng.gamma(shape, self.size / shape))


class LossyRadio(HiddenEffect):
    """Packets lost in bursts: a radio link with a good and a bad state (Gilbert 1960)."""

    strong, weak = 0.25, 0.10  # of the packets

    BURST = 1.5  # packets lost in a row, on average

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"lost_share": self.size, "burst": self.BURST}
        self._bad = False
        self._worsens = self.size / (1.0 - self.size) / self.BURST

    def reset(self, position: np.ndarray) -> None:
        self._bad = False

    def bus_delay(self, rng: np.random.Generator) -> float:
        self._bad = rng.random() < (1.0 - 1.0 / self.BURST if self._bad else self._worsens)
        return math.inf if self._bad else 0.0


class DullServos(HiddenEffect):
    """Servos that keep their goal unless a new one differs by more than a band, each servo's own a little wider."""

    strong, weak = 0.05, 0.02  # rad

    SCATTER = 0.05  # of the band between servos

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"band_rad": self.size}
        self._band = self.size * (1.0 + rng.normal(0.0, self.SCATTER, JOINT_COUNT))
        self._taken = np.zeros(JOINT_COUNT)

    def reset(self, position: np.ndarray) -> None:
        self._taken[:] = position

    def hear(self, goals: list[tuple[int, float]], fresh: bool, rng: np.random.Generator) -> list[tuple[int, float]]:
        heard = [(i, goal) for i, goal in goals if abs(goal - self._taken[i]) > self._band[i]]
        for i, goal in heard:
            self._taken[i] = goal
        return heard
