"""A gear with play: the motor's own inertia, a gap, and teeth that push only where they touch."""

import numpy as np


class GearGap:
    """All joints' motors and the gaps between them and their legs.

    Args:
      gap: rad from face to face.
      inertia: kg m^2 of a motor, seen at the output shaft.
      damping: N m s/rad of a motor, seen at the output shaft.
      count: joints.

    Attributes:
      position: (J,) rad of the motors, where the encoders sit.
    """

    STIFFNESS = 30.0  # N m/rad of the teeth in contact
    TOOTH_DAMPING = 0.015  # N m s/rad while they touch
    SUBSTEPS = 4

    def __init__(self, gap: float, inertia: float, damping: float, count: int):
        self._half, self._inertia, self._damping = gap / 2, inertia, damping
        self.position, self._velocity = np.zeros(count), np.zeros(count)

    def reset(self, position: np.ndarray) -> None:
        """Motors at rest in the middle of their gaps; the legs stand at `position` (J,) rad."""
        self.position = np.array(position, float)
        self._velocity = np.zeros_like(self.position)

    def push(self, motor_torque: np.ndarray, leg: np.ndarray, leg_velocity: np.ndarray, dt: float) -> np.ndarray:
        """Move the motors on by `dt` and return the mean torque (J,) N m of the teeth on the legs.

        Args:
          motor_torque: (J,) N m.
          leg: (J,) rad; leg_velocity: (J,) rad/s, held over `dt`.
        """
        step = dt / self.SUBSTEPS
        mean = np.zeros_like(leg)
        for i in range(self.SUBSTEPS):
            torque = self._teeth(self.position - leg - leg_velocity * (i * step), self._velocity - leg_velocity)
            speed = self._velocity * self._inertia + step * (motor_torque - torque)
            self._velocity = speed / (self._inertia + step * self._damping)
            self.position = self.position + step * self._velocity
            mean += torque
        return mean / self.SUBSTEPS

    def _teeth(self, lead: np.ndarray, closing: np.ndarray) -> np.ndarray:
        """Torque on the leg where the motor leads by more than half the gap; teeth push, they never pull."""
        sign = np.sign(lead)
        depth = np.abs(lead) - self._half
        push = self.STIFFNESS * depth + self.TOOTH_DAMPING * closing * sign
        return np.where(depth > 0, sign * np.maximum(push, 0.0), 0.0)
