"""A servo test bench: one position servo, one arm, one mass; zero hangs down.

Constants of a recording: `mass` (kg, at the arm's end), `length` (m), `kp` (the servo's own proportional gain, in its
own units), `vin` (V). What the base model holds is a stiffness per unit of kp, viscous damping and Coulomb friction.

The servo drives its motor with a voltage, so a turning motor loses torque in proportion to its speed, from the stall
torque downwards. Without power the circuit is open and that part is gone: an arm that is let go swings far more freely
than one that is driven. Stall torque and back-EMF are those of the maker's sheet in `servo_bench`; in `motor_bench`,
for a servo that reaches its limits, they are parameters too.
"""

import dataclasses
import functools

import mujoco
import numpy as np

from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import FIRM_FRICTION, Noise, Rig, Values

JOINT = "servo"
MASS, LENGTH, KP, VOLTAGE = 0.49, 0.10, 200.0, 7.4  # where a recording does not say
STALL_TORQUE = 0.52 / 5.0  # N m per V: XL330-M288, maker's sheet: 0.52 N m at 5 V
BACK_EMF = 0.303**2 / 3.37  # N m s/rad: torque constant (N m/A) squared over resistance (Ohm), published as below
ARMATURE = 0.0018  # kg m^2: 0.0017 to 0.0021 identified for this servo, github.com/Rhoban/bam, params/xl330


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
                "damping", "N m s/rad", 1e-3, 0.3, 0.015, scale="log", description="viscous friction, without back-EMF"
            ),
            Parameter(
                "friction", "N m", 1e-3, 0.2, 0.02, scale="log", description="Coulomb friction of motor and gears"
            ),
        ),
        build=build,
        apply=apply,
        noise=Noise(joint_position=0.0005, encoder_step=2 * np.pi / 4096),
        own_quantities=frozenset({"gain", "damping", "friction"}),
        has_torque_limit=True,
        joint_range=np.pi,
        rate=100.0,
        groups={"servo": (JOINT,)},
    )


@functools.cache
def motor_bench_rig() -> Rig:
    """The same bench with the motor's stall torque and back-EMF among its parameters."""
    bench = servo_bench_rig()
    motor = (
        Parameter(
            "stall_torque", "N m/V", 0.03, 0.16, STALL_TORQUE, scale="log", description="greatest torque per volt"
        ),
        Parameter(
            "back_emf", "N m s/rad", 3e-3, 0.08, BACK_EMF, scale="log", description="torque lost to speed under power"
        ),
    )
    return dataclasses.replace(
        bench,
        name="motor_bench",
        parameters=bench.parameters + motor,
        own_quantities=bench.own_quantities | {"torque_limit", "back_emf"},
        apply=apply_motor,
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
        damping=[0.015 + BACK_EMF, 0, 0],
        armature=ARMATURE,
        frictionloss=0.02,
        solimp_friction=list(FIRM_FRICTION),
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
    actuator.forcerange = [-STALL_TORQUE * VOLTAGE, STALL_TORQUE * VOLTAGE]
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

    def constant(name: str, default: float) -> np.ndarray:
        given = constants.get(name, np.full(fields.count, np.nan))
        return np.where(np.isnan(given), default, given)

    fields.model["body_mass"][:, arm] = constant("mass", MASS)
    fields.model["body_ipos"][:, arm, 2] = -constant("length", LENGTH)
    fields.scale_gain(fields.actuators(), values["gain"] * constant("kp", KP))
    limit = STALL_TORQUE * constant("vin", VOLTAGE)
    fields.model["actuator_forcerange"][:, fields.actuators()] = np.stack([-limit, limit], axis=-1)[:, None]
    fields.model["dof_damping"][:, dof] = values["damping"]
    fields.model["dof_frictionloss"][:, dof] = values["friction"]
    fields.powered_damping[:, fields.joint(JOINT)] = BACK_EMF


def apply_motor(fields: Fields, values: Values, constants: Values) -> None:
    """As `apply`, with the motor's own stall torque and back-EMF."""
    apply(fields, values, constants)
    share = (values["stall_torque"] / STALL_TORQUE)[:, None, None]
    fields.model["actuator_forcerange"][:, fields.actuators()] *= share
    fields.powered_damping[:, fields.joint(JOINT)] = values["back_emf"]
