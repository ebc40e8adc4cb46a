"""The hexapod: 18 hinges on a trunk, built with MjSpec from hexapod.toml."""

import functools
import math
import tomllib
from importlib import resources
from typing import Any

import mujoco
import numpy as np

from tcbi_contract.names import IMU_FRAME, JOINTS, LEG_JOINTS, LEGS
from tcbi_sim.fields import Fields
from tcbi_sim.ground import GROUND, add_ground
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import FIRM_FRICTION, Noise, Rig, Values

SIDES = {
    "lf": "left front",
    "lm": "left middle",
    "lr": "left rear",
    "rf": "right front",
    "rm": "right middle",
    "rr": "right rear",
}
ROBOT = 2  # collision bit of its parts
TRUNK_COLOR, LINK_COLOR = [0.16, 0.20, 0.27, 1.0], [0.93, 0.60, 0.20, 1.0]
FOOT_COLOR = [0.08, 0.08, 0.09, 1.0]


@functools.cache
def dimensions() -> dict[str, Any]:
    """The contents of hexapod.toml."""
    return tomllib.loads(resources.files("tcbi_sim.rigs").joinpath("hexapod.toml").read_text())


def stand_height() -> float:
    """Trunk origin above the ground (m) when the six feet stand at zero joint angles."""
    leg = dimensions()["leg"]
    knee = leg["femur_length"] * math.sin(leg["femur_elevation"])
    return leg["tibia_length"] * math.cos(leg["tibia_tilt"]) - knee + leg["foot_radius"]


@functools.cache
def hexapod_rig() -> Rig:
    """The built-in hexapod of the contract."""
    d = dimensions()
    nominal, bounds, noise = d["nominal"], d["range"], d["noise"]

    def parameter(name: str, unit: str, scale: str, description: str) -> Parameter:
        low, high = bounds[name]
        return Parameter(name, unit, low, high, nominal[name], scale=scale, description=description)

    legs = {leg: tuple(f"{leg}_{joint}" for joint in LEG_JOINTS) for leg in LEGS}
    groups = {f"{joint}s": tuple(f"{leg}_{joint}" for leg in LEGS) for joint in LEG_JOINTS}
    groups |= {f"{SIDES[leg]} leg": joints for leg, joints in legs.items()}
    for row, pair in (("front", "lf rf"), ("middle", "lm rm"), ("rear", "lr rr")):
        for joint in LEG_JOINTS:
            groups[f"{joint}s of the {row} legs"] = tuple(f"{leg}_{joint}" for leg in pair.split())
    return Rig(
        name="hexapod",
        joint_names=JOINTS,
        foot_names=LEGS,
        foot_geoms=tuple(f"{leg}_foot" for leg in LEGS),
        parameters=(
            parameter("friction", "1", "linear", "sliding friction between foot and ground"),
            parameter("mass", "kg", "linear", "mass of the whole robot"),
            parameter("gain", "N m/rad", "log", "stiffness of a servo's position loop"),
        ),
        build=build,
        apply=apply,
        noise=Noise(
            noise["joint_position"],
            noise["attitude"],
            noise["angular_velocity"],
            noise["linear_acceleration"],
            noise["position"],
            2 * math.pi / d["servo"]["encoder_steps"],
        ),
        own_quantities=frozenset({"gain"}),
        has_torque_limit=True,
        floating=True,
        has_imu=True,
        joint_range=d["joint"]["range"],
        speed_limit=d["servo"]["speed_limit"],
        stand_height=stand_height(),
        contact_threshold=d["foot_switch"]["threshold"],
        groups=groups,
        legs=legs,
    )


def apply(fields: Fields, values: Values, constants: Values) -> None:
    """Friction of ground and blocks, mass of all links in proportion, stiffness of all servos."""
    ground = [fields.geom("ground")] + [
        g for g in range(fields.mj.ngeom) if fields.mj.geom(g).name.startswith("block_")
    ]
    # a foot that turns on the spot rubs with the same coefficient as one that slides
    share = values["friction"] / dimensions()["nominal"]["friction"]
    fields.model["geom_friction"][:, ground, :2] *= share[:, None, None]
    robot = slice(fields.body("base_link"), None)
    factor = (values["mass"] / fields.mj.body_mass[robot].sum())[:, None]
    fields.model["body_mass"][:, robot] *= factor
    fields.model["body_inertia"][:, robot] *= factor[..., None]
    fields.scale_gain(fields.actuators(), values["gain"] / dimensions()["nominal"]["gain"])


def build(blocks: int = 0) -> mujoco.MjSpec:
    """A fresh spec at the nominal parameters, with room for a number of blocks on the ground."""
    d = dimensions()
    spec = mujoco.MjSpec()
    spec.modelname = "hexapod"
    spec.compiler.degree = False
    option = spec.option
    option.timestep = 0.002
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = d["contact"]["impratio"]
    option.iterations = 50
    option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # the same motion as dense, a third faster
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND  # one tree is one island: the same bits, a little faster
    _add_scene(spec, blocks)
    trunk = _add_trunk(spec)
    for leg in LEGS:
        _add_leg(spec, trunk, leg)
    _add_sensors(spec)
    return spec


def _add_scene(spec: mujoco.MjSpec, blocks: int) -> None:
    contact, friction = dimensions()["contact"], dimensions()["nominal"]["friction"]
    rubbing = [friction, contact["torsional_friction"], contact["rolling_friction"]]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=256,
        height=256,
        rgb1=[0.95, 0.97, 1.0],
        rgb2=[0.70, 0.78, 0.86],
    )
    spec.worldbody.add_light(pos=[0.5, -0.5, 2.0], dir=[-0.25, 0.25, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    add_ground(spec, blocks, ROBOT, rubbing, contact["solref"], contact["solimp"])


def _solid(**extra: Any) -> dict[str, Any]:
    # robot parts meet the ground and each other; MuJoCo leaves out parents with their children
    return dict(contype=ROBOT, conaffinity=GROUND | ROBOT, condim=3, friction=[0.5, 0.003, 0.0001], mass=0, **extra)


def _add_trunk(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    trunk = dimensions()["trunk"]
    half = np.array(trunk["size"]) / 2
    body = spec.worldbody.add_body(name="base_link", pos=[0, 0, stand_height()])
    body.add_freejoint(name="base_free")
    _set_inertia(body, trunk["mass"], [0, 0, 0], _box_inertia(trunk["mass"], trunk["size"]))
    body.add_geom(name="trunk", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=TRUNK_COLOR, **_solid())
    body.add_geom(
        name="nose",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.012, 0.02, 0.008],
        pos=[half[0], 0, half[2]],
        rgba=LINK_COLOR,
        contype=0,
        conaffinity=0,
        mass=0,
    )
    body.add_site(name=IMU_FRAME, pos=trunk["imu_position"], size=[0.005] * 3)
    body.add_camera(
        name="follow",
        pos=[-0.55, -0.65, 0.55],
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        xyaxes=[0.76, -0.65, 0, 0.36, 0.42, 0.83],
    )
    return body


def _add_leg(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, leg: str) -> None:
    d = dimensions()
    hip, size = d["hips"][leg], d["leg"]
    turn = hip["direction"]
    # x of a leg's frames points outward; forward is clockwise from above for a left leg, the other way for a right one
    forward = -1.0 if leg.startswith("l") else 1.0
    coxa = trunk.add_body(name=f"{leg}_coxa", pos=hip["position"], quat=[math.cos(turn / 2), 0, 0, math.sin(turn / 2)])
    _add_hinge(spec, coxa, f"{leg}_coxa", [0, 0, forward])
    _add_link(coxa, leg, "coxa", [size["coxa_length"], 0, 0], size["coxa_mass"])
    femur = coxa.add_body(name=f"{leg}_femur", pos=[size["coxa_length"], 0, 0])
    _add_hinge(spec, femur, f"{leg}_femur", [0, -1, 0])
    knee = size["femur_length"] * np.array([math.cos(size["femur_elevation"]), 0, math.sin(size["femur_elevation"])])
    _add_link(femur, leg, "femur", knee, size["femur_mass"])
    tibia = femur.add_body(name=f"{leg}_tibia", pos=knee)
    _add_hinge(spec, tibia, f"{leg}_tibia", [0, -1, 0])
    foot = size["tibia_length"] * np.array([math.sin(size["tibia_tilt"]), 0, -math.cos(size["tibia_tilt"])])
    _add_link(tibia, leg, "tibia", foot, size["tibia_mass"])
    tibia.add_geom(
        name=f"{leg}_foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[size["foot_radius"], 0, 0],
        pos=foot,
        rgba=FOOT_COLOR,
        **_solid(),
    )
    tibia.add_site(
        name=f"{leg}_foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[size["foot_radius"] * 1.5, 0, 0],
        pos=foot,
        rgba=[0, 0, 0, 0],
    )


def _add_hinge(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, axis: list[float]) -> None:
    d = dimensions()
    servo, limit = d["servo"], d["joint"]["range"]
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        damping=[servo["damping"], 0, 0],
        armature=servo["armature"],
        solimp_friction=list(FIRM_FRICTION),  # of the dry friction that an effect may add
        limited=True,
        range=[-limit - 0.05, limit + 0.05],  # mechanical stops just behind the commanded range
    )
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=d["nominal"]["gain"])
    actuator.forcelimited = True
    actuator.forcerange = [-servo["torque_limit"], servo["torque_limit"]]


def _add_link(body: mujoco.MjsBody, leg: str, name: str, end: Any, mass: float) -> None:
    radius = dimensions()["leg"]["link_radius"]
    end = np.asarray(end, float)
    length = float(np.linalg.norm(end))
    _set_inertia(body, mass, end / 2, _rod_inertia(mass, radius, end))
    body.add_geom(
        name=f"{leg}_{name}",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[radius * (0.7 if name == "tibia" else 1.0), 0, 0],
        fromto=[*(end * min(1, 0.004 / length)), *(end * 0.96)],
        rgba=LINK_COLOR,
        **_solid(),
    )


def _set_inertia(body: mujoco.MjsBody, mass: float, center: Any, inertia: np.ndarray) -> None:
    body.explicitinertial = True
    body.mass = mass
    body.ipos = center
    body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]


def _box_inertia(mass: float, size: Any) -> np.ndarray:
    x, y, z = np.square(size)
    return np.diag([y + z, x + z, x + y]) * mass / 12


def _rod_inertia(mass: float, radius: float, end: np.ndarray) -> np.ndarray:
    """Inertia (3, 3) of a solid cylinder along `end`, about its middle, in the body's axes."""
    length = np.linalg.norm(end)
    along = np.outer(end, end) / length**2
    lengthwise, across = mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12
    return lengthwise * along + across * (np.eye(3) - along)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    site = mujoco.mjtObj.mjOBJ_SITE
    for joint in JOINTS:
        spec.add_sensor(
            name=f"position/{joint}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    for name, kind in (
        ("attitude", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
        ("accelerometer", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=site, objname=IMU_FRAME)
    for leg in LEGS:
        spec.add_sensor(name=f"contact/{leg}", type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=site, objname=f"{leg}_foot")
    spec.add_sensor(
        name="tracker", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname="base_link"
    )
