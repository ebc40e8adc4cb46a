"""A part of the ground with another grip: two boxes that meet at a line and are level with the ground as it was."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

PATCH, REST = "slippery_ground", "ground_beyond"
HALF = 3.0  # m, half the edge of both: farther than a rollout goes
DEPTH = 2e-3  # m that the old ground lies below them, out of the reach of feet that sink in


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    ground = spec.geom("ground")
    ground.pos = [0, 0, -DEPTH]
    for name, color in ((PATCH, [0.55, 0.7, 0.85, 0.6]), (REST, [0, 0, 0, 0])):
        spec.body("ground").add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[HALF, HALF, 0.01],
            pos=[0, 0, -0.01],
            rgba=color,
            contype=ground.contype,
            conaffinity=ground.conaffinity,
            condim=ground.condim,
            friction=ground.friction,
            priority=ground.priority,
            solref=ground.solref,
            solimp=ground.solimp,
        )


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    patch, rest = fields.geom(PATCH), fields.geom(REST)
    friction, place, turned = (fields.model[f"geom_{name}"] for name in ("friction", "pos", "quat"))
    friction[:, rest, :2] = friction[:, fields.geom("ground"), :2]
    friction[:, patch, :2] = friction[:, rest, :2] * values["grip"][:, None]
    heading = values["heading"]
    for geom, middle in ((patch, values["begin"] + HALF), (rest, values["begin"] - HALF)):
        place[:, geom, 0], place[:, geom, 1] = middle * np.cos(heading), middle * np.sin(heading)
        turned[:, geom, 0], turned[:, geom, 3] = np.cos(heading / 2), np.sin(heading / 2)


EFFECT = Effect(
    name="slippery_ground",
    physics=(
        "Grip ends at a line: a mat's edge, a polished or dusty part of the floor. Feet beyond it slide under the "
        "sideways load that the others hold, so the robot turns or stops getting ahead once it is there, and the "
        "joints hardly show it."
    ),
    source=(
        "Popov, Contact Mechanics and Friction, 2nd edition (2017), chapter 10 (Coulomb's law); MuJoCo: geom/friction "
        "of two flat boxes in place of the ground"
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
