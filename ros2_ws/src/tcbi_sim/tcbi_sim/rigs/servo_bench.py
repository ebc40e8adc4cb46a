"""A servo test bench: one position servo, one arm, one mass; zero hangs down.

Constants of a recording: `mass` (kg, at the arm's end), `length` (m), `kp` (the servo's own proportional gain, in its
own units). What the base model holds is a stiffness per unit of kp, viscous damping and Coulomb friction.
"""

import functools

import mujoco
import numpy as np

from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Noise, Rig, Values

JOINT = "servo"
MASS, LENGTH, KP = 0.49, 0.10, 200.0  # where a recording does not say
TORQUE_LIMIT = 0.8  # N m: XL330-M288, 0.52 N m stall at 5 V (maker's sheet), in proportion at 7.4 V
ARMATURE = 0.0015  # kg m^2


@functools.cache
def servo_bench_rig() -> Rig:
    """The built-in servo test bench."""
    return Rig(
        name="servo_bench",
        joint_names=(JOINT,),
        parameters=(
            Parameter(
                "gain", "N m/rad/kp", 2e-4, 5e-2, 4e-3, scale="log", description="stiffness per unit of the servo's kp"
            ),
            Parameter(
                "damping", "N m s/rad", 1e-3, 0.3, 0.03, scale="log", description="viscous friction, back-EMF included"
            ),
            Parameter(
                "friction", "N m", 1e-3, 0.2, 0.02, scale="log", description="Coulomb friction of motor and gears"
            ),
        ),
        build=build,
        apply=apply,
        noise=Noise(joint_position=0.0005, encoder_step=2 * np.pi / 4096),
        joint_range=np.pi,
        rate=100.0,
        groups={"servo": (JOINT,)},
    )


def build(blocks: int = 0) -> mujoco.MjSpec:
    """A fresh spec at nominal parameters; a bench has no ground and no blocks."""
    spec = mujoco.MjSpec()
    spec.modelname = "servo_bench"
    spec.compiler.degree = False
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_light(pos=[0, -1, 1])
    arm = spec.worldbody.add_body(name="arm", pos=[0, 0, 0.3])
    arm.add_joint(
        name=JOINT,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, -1, 0],
        damping=[0.03, 0, 0],
        armature=ARMATURE,
        frictionloss=0.02,
    )
    arm.explicitinertial = True
    arm.mass, arm.ipos, arm.inertia = MASS, [0, 0, -LENGTH], [1e-5] * 3
    arm.add_geom(
        name="rod",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.005, 0, 0],
        fromto=[0, 0, 0, 0, 0, -LENGTH],
        mass=0,
        contype=0,
        conaffinity=0,
    )
    actuator = spec.add_actuator(name=JOINT, target=JOINT, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=1.0)
    actuator.forcelimited = True
    actuator.forcerange = [-TORQUE_LIMIT, TORQUE_LIMIT]
    spec.add_sensor(
        name=f"position/{JOINT}",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname=JOINT,
    )
    return spec


def apply(fields: Fields, values: Values, constants: Values) -> None:
    """The recording's mass, length and kp, and the servo's stiffness, damping and friction."""
    arm, dof = fields.body("arm"), fields.dof(JOINT)
    one = np.ones(fields.count)
    fields.model["body_mass"][:, arm] = constants.get("mass", MASS * one)
    fields.model["body_ipos"][:, arm, 2] = -constants.get("length", LENGTH * one)
    fields.scale_gain(fields.actuators(), values["gain"] * constants.get("kp", KP * one))
    fields.model["dof_damping"][:, dof] = values["damping"]
    fields.model["dof_frictionloss"][:, dof] = values["friction"]
