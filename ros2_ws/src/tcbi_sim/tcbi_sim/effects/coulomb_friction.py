"""Dry friction in every joint."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, lacks
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

NO_INPUT = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
DAMPING = 2 / 3  # s/rad, of bristles that bend, per torque: twice the torque is twice the bristles
LEAST = 1e-12  # N m; without any torque the bristles' stiffness would be undefined
STRIBECK_SPEED = 0.1  # rad/s; without meaning while breaking away takes no more than sliding
STIFFNESS_AT, DAMPING_AT = 5, 6  # columns of a friction actuator's dynprm
SLIDING_AT, BREAKAWAY_AT = 3, 4  # columns of its biasprm


def _name(joint: str) -> str:
    return f"{joint}/friction"


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    for joint in rig.joint_names:
        bristles = spec.add_actuator(name=_name(joint), target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        lugre = [1.0, DAMPING, LEAST, LEAST, STRIBECK_SPEED]
        bristles.set_to_dcmotor(motorconst=[0, 0], resistance=1.0, lugre=lugre, ctrlspec=NO_INPUT)


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    actuators = fields.actuators(tuple(_name(j) for j in rig.joint_names))
    torque = np.maximum(values["torque"], LEAST)[:, None]
    fields.model["actuator_dynprm"][:, actuators, STIFFNESS_AT] = torque / values["presliding"][:, None]
    fields.model["actuator_dynprm"][:, actuators, DAMPING_AT] = DAMPING * torque
    fields.model["actuator_biasprm"][:, actuators, SLIDING_AT] = torque
    fields.model["actuator_biasprm"][:, actuators, BREAKAWAY_AT] = torque


EFFECT = Effect(
    name="coulomb_friction",
    physics=(
        "Gears and bushings resist motion with a torque that does not depend on speed. Small errors of the position "
        "loop stay below it and are never corrected, so joints stop short of their target and stick at reversals. "
        "Before it slides, a joint gives way a little and springs back, as if teeth and grease were bristles that bend."
    ),
    source=(
        "Canudas de Wit et al., A new model for control of systems with friction, IEEE Transactions on Automatic "
        "Control 40 (1995), without the Stribeck effect; MuJoCo: actuator/dcmotor/lugre"
    ),
    parameters=(
        Parameter("torque", "N m", 0.0, 0.15, 0.03, null=0.0, description="friction torque of each joint"),
        Parameter("presliding", "rad", 0.001, 0.02, 0.003, scale="log", description="bend before a joint slides"),
    ),
    apply=apply,
    edit=edit,
    requires=lacks("friction"),
)
