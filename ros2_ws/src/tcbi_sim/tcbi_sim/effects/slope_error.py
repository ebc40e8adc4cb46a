"""The ground is not as steep as noted."""

import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.measurement import quaternion_from_rpy
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig
from tcbi_sim.sensing import multiply


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    ground = fields.body("ground")
    turn = quaternion_from_rpy(values["roll"], values["pitch"], np.zeros(fields.count))
    fields.model["body_quat"][:, ground] = multiply(turn, fields.model["body_quat"][:, ground])


EFFECT = Effect(
    name="slope_error",
    physics=(
        "The board was tilted by a few degrees more or less than written down. Gravity pulls the robot another way: "
        "the attitude is off by a constant and the downhill legs carry more."
    ),
    source="geometry",
    parameters=(
        Parameter("roll", "rad", -0.1, 0.1, 0.03, null=0.0, description="true slope less the noted one"),
        Parameter("pitch", "rad", -0.1, 0.1, 0.03, null=0.0, description="true slope less the noted one"),
    ),
    apply=apply,
    requires=floating_rig,
)
