"""Servos that give less torque than their sheet says."""

import numpy as np

from tcbi_sim.effect import Effect, Values, lacks, torque_limited
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    ids = fields.actuators()
    limit = fields.model["actuator_forcerange"][:, ids, 1] * values["share"][:, None]
    fields.model["actuator_forcerange"][:, ids] = np.stack([-limit, limit], axis=-1)


EFFECT = Effect(
    name="torque_saturation",
    physics=(
        "Current limits, supply and worn motors cap the torque below the data sheet's stall torque. Loaded joints "
        "follow well up to a load and then give way, while unloaded ones show nothing."
    ),
    source="Feetech STS maker's sheets (stall torque against supply voltage); MuJoCo: actuator/forcerange",
    parameters=(
        Parameter("share", "1", 0.1, 1.0, 0.6, null=1.0, scale="log", description="of the torque limit that is left"),
    ),
    apply=apply,
    requires=lambda rig: torque_limited(rig) or lacks("torque_limit")(rig),
)
