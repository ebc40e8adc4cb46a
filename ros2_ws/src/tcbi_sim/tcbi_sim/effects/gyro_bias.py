"""A gyroscope that does not read zero at rest."""

import numpy as np

from tcbi_sim.effect import Effect, Values, rig_with_imu
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.sensing.gyro_bias += np.stack([values["x"], values["y"], values["z"]], axis=-1)


EFFECT = Effect(
    name="gyro_bias",
    physics=(
        "Micromachined gyroscopes read a constant rate at rest that changes with temperature. Body rates are off by "
        "the same amount at every moment."
    ),
    source="Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd edition (2004), chapter 4",
    parameters=tuple(
        Parameter(axis, "rad/s", -0.1, 0.1, 0.02, null=0.0, description=f"about the IMU's {axis} axis")
        for axis in "xyz"
    ),
    apply=apply,
    requires=rig_with_imu,
)
