"""A mass that the model does not know of, somewhere on the trunk."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    trunk = fields.body(rig.base)
    mass, center = fields.model["body_mass"], fields.model["body_ipos"]
    added, old = values["mass"], mass[:, trunk].copy()
    place = np.stack([values["x"], values["y"], np.full_like(added, 0.03)], axis=-1)
    total = old + added
    offset = place - center[:, trunk]
    _add_inertia(fields, trunk, old * added / total, offset)
    center[:, trunk] += offset * (added / total)[:, None]
    mass[:, trunk] = total


def _add_inertia(fields: Fields, body: int, reduced: np.ndarray, offset: np.ndarray) -> None:
    """Of two point masses about their common centre: reduced mass (B,), and offset (B, 3) in the body's axes."""
    inertia, turn, axes = fields.model["body_inertia"], fields.model["body_iquat"], np.empty(9)
    for b in np.flatnonzero(reduced):
        mujoco.mju_quat2Mat(axes, turn[b, body])
        principal, r = axes.reshape(3, 3), offset[b]
        tensor = principal @ np.diag(inertia[b, body]) @ principal.T + reduced[b] * (r @ r * np.eye(3) - np.outer(r, r))
        mujoco.mju_eig3(inertia[b, body], axes, turn[b, body], tensor.ravel())


EFFECT = Effect(
    name="payload",
    physics=(
        "A battery, camera or cable adds weight at a place. All legs carry more, those near it most, and the trunk "
        "leans towards it; on a slope more so."
    ),
    source=(
        "Atkeson, An and Hollerbach, Estimation of inertial parameters of manipulator loads and links, IJRR 5 (1986)"
    ),
    parameters=(
        Parameter("mass", "kg", 0.0, 0.5, 0.15, null=0.0, description="added to the trunk, 30 mm above its middle"),
        Parameter("x", "m", -0.1, 0.1, 0.0, description="forward of the trunk's middle"),
        Parameter("y", "m", -0.06, 0.06, 0.0, description="to the left of the trunk's middle"),
    ),
    apply=apply,
    requires=floating_rig,
)
