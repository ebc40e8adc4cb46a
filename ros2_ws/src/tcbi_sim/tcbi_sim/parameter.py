"""A named physical quantity with bounds, a best guess, and the value at which it does nothing."""

from dataclasses import dataclass

import numpy as np

from tcbi_sim.errors import SimError


@dataclass(frozen=True)
class Parameter:
    """A physical quantity whose prior is flat between `low` and `high` on its scale."""

    name: str
    unit: str
    low: float
    high: float
    nominal: float  # best guess before any data
    null: float | None = None  # where an effect vanishes; None for a rig's own parameters
    scale: str = "linear"  # or "log"
    description: str = ""

    def __post_init__(self) -> None:
        if self.scale not in ("linear", "log"):
            raise SimError(f"parameter {self.name!r}: scale {self.scale!r}, allowed is linear or log")
        if not np.isfinite([self.low, self.high]).all():
            raise SimError(f"parameter {self.name!r}: bounds {self.low} to {self.high}, allowed are finite ones")
        if not self.low < self.high or (self.scale == "log" and self.low <= 0):
            raise SimError(
                f"parameter {self.name!r}: bounds {self.low} to {self.high} do not suit a {self.scale} scale"
            )
        for label, value in (("nominal", self.nominal), ("null", self.null)):
            if value is not None and not self.low <= value <= self.high:
                raise SimError(f"parameter {self.name!r}: {label} {value} lies outside {self.low} to {self.high}")

    def to_unit(self, value: np.ndarray | float) -> np.ndarray:
        """Physical values -> [0, 1] on the parameter's scale, where the prior is uniform."""
        if self.scale == "log":
            return np.log(np.asarray(value) / self.low) / np.log(self.high / self.low)
        return (np.asarray(value) - self.low) / (self.high - self.low)

    def from_unit(self, unit: np.ndarray | float) -> np.ndarray:
        """[0, 1] -> physical values, clipped to the bounds."""
        unit = np.clip(unit, 0.0, 1.0)
        if self.scale == "log":
            return self.low * (self.high / self.low) ** np.asarray(unit)
        return self.low + (self.high - self.low) * np.asarray(unit)

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> np.ndarray:
        """Draws from the prior."""
        return self.from_unit(rng.random(size))
