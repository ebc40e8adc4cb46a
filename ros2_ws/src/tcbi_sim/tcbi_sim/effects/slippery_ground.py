"""A part of the ground with another grip."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

PATCH = "slippery_ground"
HALF = 3.0  # m, half the edge of the patch: farther than a rollout goes
THICKNESS = 5e-4  # m that the patch stands above the ground, so that feet on it touch nothing else


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    ground = spec.geom("ground")
    spec.body("ground").add_geom(
        name=PATCH,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[HALF, HALF, 0.01],
        pos=[HALF, 0, THICKNESS - 0.01],
        rgba=[0.55, 0.7, 0.85, 0.6],
        contype=ground.contype,
        conaffinity=ground.conaffinity,
        condim=ground.condim,
        friction=ground.friction,
        priority=ground.priority,
        solref=ground.solref,
        solimp=ground.solimp,
    )


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    patch, ground = fields.geom(PATCH), fields.geom("ground")
    fields.model["geom_friction"][:, patch, 0] = fields.model["geom_friction"][:, ground, 0] * values["grip"]
    heading, begin = values["heading"], values["begin"] + HALF
    place = fields.model["geom_pos"]
    place[:, patch, 0], place[:, patch, 1] = begin * np.cos(heading), begin * np.sin(heading)
    zero = np.zeros_like(heading)
    fields.model["geom_quat"][:, patch] = np.stack([np.cos(heading / 2), zero, zero, np.sin(heading / 2)], axis=-1)


EFFECT = Effect(
    name="slippery_ground",
    physics=(
        "Grip ends at a line: a mat's edge, a polished or dusty part of the floor. Feet beyond it slide under the "
        "sideways load that the others hold, so the robot turns or stops getting ahead once it is there, and the "
        "joints hardly show it."
    ),
    source=(
        "Popov, Contact Mechanics and Friction, 2nd edition (2017), chapter 10 (Coulomb's law); MuJoCo: geom/friction "
        "of a flat box on the ground"
    ),
    parameters=(
        Parameter(
            "grip", "1", 0.05, 1.5, 0.25, null=1.0, scale="log", description="friction there over that elsewhere"
        ),
        Parameter("begin", "m", -0.3, 1.0, 0.0, description="from the start to the edge of the patch"),
        Parameter("heading", "rad", -np.pi, np.pi, 0.0, description="in which the patch lies; 0 ahead, left positive"),
    ),
    apply=apply,
    edit=edit,
    requires=floating_rig,
)
