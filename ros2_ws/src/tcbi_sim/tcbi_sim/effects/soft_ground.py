"""Ground or feet that give way."""

import numpy as np

from tcbi_sim.effect import Effect, Values, floating_rig
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    ground = np.flatnonzero(fields.mj.geom_bodyid == fields.body("ground"))
    fields.model["geom_solref"][:, ground, 0] += values["time_constant"][:, None]
    fields.model["geom_solimp"][:, ground, 2] += values["depth"][:, None]


EFFECT = Effect(
    name="soft_ground",
    physics=(
        "Foam, carpet or rubber feet let a foot sink and spring back over tens of milliseconds, the stiffer the deeper "
        "it has sunk. The trunk settles after each step and contacts come late."
    ),
    source="MuJoCo: solver parameters (solref's time constant, solimp's width)",
    parameters=(
        Parameter("time_constant", "s", 0.0, 0.08, 0.02, null=0.0, description="added to the contact's own"),
        Parameter("depth", "m", 0.0, 0.01, 0.002, null=0.0, description="over which it stiffens, beyond the contact's"),
    ),
    apply=apply,
    requires=floating_rig,
)
