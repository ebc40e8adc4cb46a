"""What the servos can give: with or without power, weakened by supply or heat, in series with links that bend.

power = ServoPower(fields, actuators, dofs)
power.begin()              # once rig and effects have written their fields
power.write(torque_on)     # again whenever `torque_on` or `fields.strength` has changed
"""

import numpy as np

from tcbi_sim.fields import Fields


class ServoPower:
    """Stiffness, greatest torque and back-EMF of B simulations' servos."""

    def __init__(self, fields: Fields, actuators: np.ndarray, dofs: np.ndarray):
        self._fields, self._actuators, self._dofs = fields, actuators, dofs
        self._limit: np.ndarray | None = None

    def begin(self) -> None:
        """Take what rig and effects have written for servos at full strength."""
        f, servos = self._fields, self._actuators
        self._gain, self._bias = (f.model[name][:, servos] for name in ("actuator_gainprm", "actuator_biasprm"))
        self._damping_off = f.model["dof_damping"][:, self._dofs] if f.powered_damping.any() else None
        self._limit = None

    @property
    def is_stale(self) -> bool:
        """Whether the servos' strength has changed since it was written."""
        return not np.array_equal(self._fields.strength, self._written)

    def write(self, torque_on: np.ndarray) -> None:
        """Write the fields for servos that have power or not, (B,)."""
        f = self._fields
        self._written = f.strength.copy()
        if self._damping_off is not None:
            added = np.where(torque_on[:, None], f.powered_damping, 0.0)
            f.model["dof_damping"][:, self._dofs] = self._damping_off + added
        gain, bias, on = self._gain, self._bias, torque_on[:, None, None]
        share = self._share()
        if share is not None:
            gain, bias = gain.copy(), bias.copy()
            gain[..., 0] *= share
            bias[..., 1] *= share
        f.model["actuator_gainprm"][:, self._actuators] = np.where(on, gain, 0.0)
        f.model["actuator_biasprm"][:, self._actuators] = np.where(on, bias, 0.0)
        self._write_limit()

    def _share(self) -> np.ndarray | None:
        """(B, J) of the stiffness that is left; a servo and the link that it bends are springs in series."""
        f = self._fields
        if f.compliance.any():
            stiffness = self._gain[..., 0] * f.strength
            return f.strength / (1 + stiffness * f.compliance)
        return f.strength if (f.strength != 1.0).any() else None

    def _write_limit(self) -> None:
        f = self._fields
        if self._limit is None:
            if (f.strength == 1.0).all():
                return
            self._limit = f.model["actuator_forcerange"][:, self._actuators].copy()
        f.model["actuator_forcerange"][:, self._actuators] = self._limit * f.strength[..., None]
