"""A cable that pulls at the trunk."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

CABLE, FAR_END, TRUNK_END = "cable_pull", "cable_pull/far", "cable_pull/trunk"
REACH, HEIGHT = 2.0, 0.5  # m from the start to where the cable is held, and above the trunk
LENGTH = float(np.hypot(REACH, HEIGHT))


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    spec.worldbody.add_site(name=FAR_END, pos=[REACH, 0, rig.stand_height + HEIGHT], size=[0.005] * 3)
    spec.body(rig.base).add_site(name=TRUNK_END, size=[0.003] * 3)
    cable = spec.add_tendon(name=CABLE, width=0.002, rgba=[0.1, 0.1, 0.1, 1])
    cable.springlength = [0, 0]
    cable.wrap_site(FAR_END)
    cable.wrap_site(TRUNK_END)


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    x, y = values["x"], values["y"]
    level = np.hypot(x, y)
    safe = np.where(level > 0, level, 1.0)
    far, cable = fields.mj.site(FAR_END).id, fields.mj.tendon(CABLE).id
    direction = np.stack([np.where(level > 0, x / safe, 1.0), y / safe], axis=-1)
    fields.model["site_pos"][:, far, :2] = REACH * direction
    fields.model["tendon_stiffness"][:, cable] = level / REACH


EFFECT = Effect(
    name="cable_pull",
    physics=(
        "A cable for power or data drags at the trunk from where it is held, with nearly the same force wherever the "
        "robot goes. Standing, the trunk leans towards it and the legs on that side carry more; walking, the robot "
        "drifts and turns out of its way."
    ),
    source="statics; MuJoCo: spatial tendon with tendon/stiffness, far longer than the way that the robot goes",
    parameters=(
        Parameter("x", "N", -1.5, 1.5, 0.4, null=0.0, description="pull along the start's forward direction, level"),
        Parameter("y", "N", -1.5, 1.5, 0.2, null=0.0, description="pull to the left, level"),
    ),
    apply=apply,
    edit=edit,
    requires=floating_rig,
)
