"""A gear with play: the motor's own inertia, a gap, and teeth that push only where they touch."""

import numpy as np

from tcbi_bringup.emulated_robot.mechanics import Build

LEG_SHARE = 1 / 7  # of a joint's drawn inertia and damping, that stays at the leg's side of a gear with play


class GearGap:
    """All joints' motors and the gaps between them and their legs.

    Args:
      gap: rad from face to face.
      inertia: kg m^2 of a motor, seen at the output shaft.
      damping: N m s/rad of a motor, seen at the output shaft.
      count: joints.
      compliance: rad/(N m) between motor and leg, at least that of the teeth.

    Attributes:
      position: (J,) rad of the motors, where the encoders sit; velocity: (J,) rad/s.
    """

    STIFFNESS = 30.0  # N m/rad of the teeth in contact
    TOOTH_DAMPING = 0.015  # N m s/rad while they touch
    SUBSTEPS = 4

    def __init__(self, gap: float, inertia: float, damping: float, count: int, compliance: float = 0.0):
        self._half, self._inertia, self._damping = gap / 2, inertia, damping
        self._stiffness = min(self.STIFFNESS, 1.0 / compliance) if compliance else self.STIFFNESS
        self.position, self.velocity = np.zeros(count), np.zeros(count)

    @staticmethod
    def of(build: Build, count: int) -> "GearGap | None":
        """What lies between motors and legs, where they are not one piece; takes the motors' share off the joints."""
        if not (build.gap or build.rotor or build.compliance):
            return None
        motor = 1.0 - LEG_SHARE
        inertia, damping = motor * build.joint_armature + build.rotor, motor * build.joint_damping
        build.joint_armature *= LEG_SHARE
        build.joint_damping *= LEG_SHARE
        return GearGap(build.gap, inertia, damping, count, build.compliance)

    def reset(self, position: np.ndarray) -> None:
        """Motors at rest in the middle of their gaps; the legs stand at `position` (J,) rad."""
        self.position = np.array(position, float)
        self.velocity = np.zeros_like(self.position)

    def push(self, motor_torque: np.ndarray, leg: np.ndarray, leg_velocity: np.ndarray, dt: float) -> np.ndarray:
        """Move the motors on by `dt` and return the mean torque (J,) N m of the teeth on the legs.

        Args:
          motor_torque: (J,) N m.
          leg: (J,) rad; leg_velocity: (J,) rad/s, held over `dt`.
        """
        step = dt / self.SUBSTEPS
        mean = np.zeros_like(leg)
        for i in range(self.SUBSTEPS):
            torque = self._teeth(self.position - leg - leg_velocity * (i * step), self.velocity - leg_velocity)
            speed = self.velocity * self._inertia + step * (motor_torque - torque)
            self.velocity = speed / (self._inertia + step * self._damping)
            self.position = self.position + step * self.velocity
            mean += torque
        return mean / self.SUBSTEPS

    def _teeth(self, lead: np.ndarray, closing: np.ndarray) -> np.ndarray:
        """Torque on the leg where the motor leads by more than half the gap; teeth push, they never pull.

        Without a gap the teeth on both sides are always in contact.
        """
        if not self._half:
            return self._stiffness * lead + self.TOOTH_DAMPING * closing
        sign = np.sign(lead)
        depth = np.abs(lead) - self._half
        push = self._stiffness * depth + self.TOOTH_DAMPING * closing * sign
        return np.where(depth > 0, sign * np.maximum(push, 0.0), 0.0)
