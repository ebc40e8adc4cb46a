"""Play between each servo and its link."""

import mujoco
import numpy as np

from tcbi_sim.effect import Effect, Values, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

GAP = 1e-3  # rad, of the compiled model; every simulation writes its own
PLAY_DAMPING = 0.005  # N m s/rad, grease between the flanks


def edit(spec: mujoco.MjSpec, rig: Rig, site: str) -> None:
    for name in rig.joint_names:
        hinge = spec.joint(name)
        hinge.parent.add_joint(
            name=f"{name}/play",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=hinge.axis,
            pos=hinge.pos,
            limited=True,
            range=[-GAP, GAP],
            damping=[PLAY_DAMPING, 0, 0],
            armature=1e-4,
            frictionloss=0,  # these three, too, in place of a model file's defaults
            stiffness=[0, 0, 0],
            springref=0,
            solref_limit=[0.01, 1.0],
            solimp_limit=[0.99, 0.999, 0.001, 0.5, 2.0],
        )


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    joints = [fields.mj.joint(f"{name}/play").id for name in rig.joint_names]
    half = np.maximum(values["gap"], 1e-5)[:, None] / 2
    fields.model["jnt_range"][:, joints, 0] = -half
    fields.model["jnt_range"][:, joints, 1] = half


EFFECT = Effect(
    name="backlash",
    physics=(
        "Between the flanks of the gears, and in horn and screws, a link moves freely within a small angle. It hangs "
        "on one side under load and flips when the load reverses, which the servo's own encoder does not see: feet "
        "land early or late."
    ),
    source=(
        "Nordin and Gutman, Controlling mechanical systems with backlash: a survey, Automatica 38 (2002); MuJoCo: a "
        "second hinge of small range in series"
    ),
    parameters=(Parameter("gap", "rad", 0.0, 0.1, 0.03, null=0.0, description="full free angle of each joint"),),
    apply=apply,
    edit=edit,
    requires=position_servos,
)
