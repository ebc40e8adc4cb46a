"""A mass that the model does not know of, somewhere on the trunk, or a trunk whose weight lies off its middle."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

HEIGHT = 0.03  # m, above the trunk's middle
REACH = (0.1, 0.06)  # m, forward and to the left: for the inertia, no farther off however large a moment is


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    trunk = fields.body(rig.base)
    mass, center = fields.model["body_mass"], fields.model["body_ipos"]
    added, old = values["mass"], mass[:, trunk].copy()
    moment = np.stack([values["moment_x"], values["moment_y"], HEIGHT * added], axis=-1)
    place = np.clip(moment[:, :2], -np.outer(added, REACH), np.outer(added, REACH)) / np.maximum(added, 1e-9)[:, None]
    place = np.column_stack([place, np.full_like(added, HEIGHT)])
    total = old + added
    _add_inertia(fields, trunk, old * added / total, place - center[:, trunk])
    center[:, trunk] = (old[:, None] * center[:, trunk] + moment) / total[:, None]
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
        "leans towards it; on a slope more so. How far it leans goes with the first moment, mass times distance, "
        "which rollouts tell better than either. A moment without a mass is a trunk whose centre of mass is elsewhere."
    ),
    source=(
        "Atkeson, An and Hollerbach, Estimation of inertial parameters of manipulator loads and links, IJRR 5 (1986)"
    ),
    parameters=(
        Parameter("mass", "kg", 0.0, 0.5, 0.15, null=0.0, description="added to the trunk, 30 mm above its middle"),
        Parameter("moment_x", "kg m", -0.03, 0.03, 0.006, null=0.0, description="the mass times how far forward it is"),
        Parameter(
            "moment_y", "kg m", -0.03, 0.03, 0.003, null=0.0, description="the mass times how far to the left it is"
        ),
    ),
    apply=apply,
    requires=floating_rig,
)
