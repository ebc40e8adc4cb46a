"""An IMU that is not mounted parallel to the trunk."""

import numpy as np

from tcbi_sim.effect import Effect, Values, rig_with_imu
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.sensing.imu_tilt += np.stack([values["roll"], values["pitch"]], axis=-1)


EFFECT = Effect(
    name="imu_tilt",
    physics=(
        "A board glued a little askew shows a lean that is not there, the same at every moment, and mixes the axes of"
        " rates and accelerations. The joints fit, the attitude does not."
    ),
    source=(
        "Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd edition (2004), chapter 8 (mounting "
        "misalignment)"
    ),
    parameters=(
        Parameter("roll", "rad", -0.15, 0.15, 0.03, null=0.0, description="of the IMU against the trunk"),
        Parameter("pitch", "rad", -0.15, 0.15, 0.03, null=0.0, description="of the IMU against the trunk"),
    ),
    apply=apply,
    requires=rig_with_imu,
)
