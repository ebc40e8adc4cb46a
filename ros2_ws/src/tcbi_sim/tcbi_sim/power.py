"""What the servos can give: with or without power, weakened by supply or heat, in series with links that bend.

power = ServoPower(fields, actuators, dofs)
power.begin()              # once rig and effects have written their fields
power.write(torque_on)     # again whenever `torque_on` or `fields.strength` has changed
"""

import numpy as np

from tcbi_sim.fields import Fields

MADE_UP = "back_emf_made_up"  # in `fields.memory`: back-EMF that loops make up for while they can, (B, J) N m s/rad


class ServoPower:
    """Stiffness, greatest torque and back-EMF of B simulations' servos.

    Attributes:
      back_emf: (B, J) N m s/rad, that acts just now.
    """

    back_emf: np.ndarray

    def __init__(self, fields: Fields, actuators: np.ndarray, dofs: np.ndarray):
        self._fields, self._actuators, self._dofs = fields, actuators, dofs

    def begin(self) -> None:
        """Take what rig and effects have written for servos at full strength."""
        f, servos = self._fields, self._actuators
        self._gain, self._bias = (f.model[name][:, servos] for name in ("actuator_gainprm", "actuator_biasprm"))
        self._made_up = f.memory.get(MADE_UP, np.zeros(f.strength.shape))
        self._damping_off = f.model["dof_damping"][:, self._dofs] if f.powered_damping.any() else None
        self._limit = f.model["actuator_forcerange"][:, servos]
        f.stall_torque[...] = np.where(self._limit[..., 1] > 0, self._limit[..., 1], 1.0)
        self._weakened = False

    @property
    def is_stale(self) -> bool:
        """Whether the servos' strength has changed since it was written."""
        return not np.array_equal(self._fields.strength, self._written)

    def write(self, torque_on: np.ndarray) -> None:
        """Write the fields for servos that have power or not, (B,)."""
        f = self._fields
        self._written = f.strength.copy()
        self.back_emf = np.where(torque_on[:, None], f.powered_damping, 0.0)
        if self._damping_off is not None:
            f.model["dof_damping"][:, self._dofs] = self._damping_off + self.back_emf
        (gain, bias), on = self._of_the_link(), torque_on[:, None, None]
        f.model["actuator_gainprm"][:, self._actuators] = np.where(on, gain, 0.0)
        f.model["actuator_biasprm"][:, self._actuators] = np.where(on, bias, 0.0)
        if self._weakened or (f.strength != 1.0).any():
            f.model["actuator_forcerange"][:, self._actuators] = self._limit * f.strength[..., None]
            self._weakened = True

    def _of_the_link(self) -> tuple[np.ndarray, np.ndarray]:
        """Gain and bias as the links feel them, (B, J, ...); a servo and the link that it bends are springs in series.

        The servo's angle is ahead of the link's by compliance times the torque between them, which is the actuator's
        less back-EMF. Without that angle, k (target - servo) - d speed is (k (target - link) - d speed) / (1 + k
        compliance), where d has the part of back-EMF that the loop does not make up for.
        """
        f, gain, bias = self._fields, self._gain.copy(), self._bias.copy()
        softer = 1 + gain[..., 0] * f.strength * f.compliance
        gain[..., 0] *= f.strength / softer
        bias[..., 1] *= f.strength / softer
        bias[..., 2] = (bias[..., 2] + self._made_up - f.powered_damping) / softer + f.powered_damping
        return gain, bias
