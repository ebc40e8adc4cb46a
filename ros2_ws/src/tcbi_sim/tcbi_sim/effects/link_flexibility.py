"""Links that bend under the servos' torque."""

import mujoco

from tcbi_sim.effect import Effect, Values, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    kinds = {"force": mujoco.mjtSensor.mjSENS_JOINTACTFRC, "velocity": mujoco.mjtSensor.mjSENS_JOINTVEL}
    for what, kind in kinds.items():
        for name in rig.joint_names:
            spec.add_sensor(name=f"{what}/{name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name)


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.compliance += values["compliance"][:, None]


EFFECT = Effect(
    name="link_flexibility",
    physics=(
        "Printed links, brackets and horns twist in proportion to the torque that goes through them. The servo and its "
        "encoder stand where they should while the foot behind them gives way, so the trunk hangs lower than the joint "
        "angles tell. The bending follows the torque at once: vibrations of the links themselves are left out."
    ),
    source=(
        "Spong, Modeling and control of elastic joint robots, Journal of Dynamic Systems, Measurement, and Control 109 "
        "(1987), in its quasi-static limit: servo and link are springs in series"
    ),
    parameters=(
        Parameter(
            "compliance", "rad/(N m)", 0.0, 0.4, 0.1, null=0.0, description="angle that each link bends by per torque"
        ),
    ),
    apply=apply,
    edit=edit,
    requires=position_servos,
)
