"""The robot's body and the ground under it as MJCF, written as XML from the drawing.

The ground is a plane at z = 0 of the plane's own frame; a slope tilts gravity instead of the plane. Feet are firm
rubber caps: stiff contacts, an elliptic friction cone and a friction that is hard against slow creep.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco

from tcbi_bringup.emulated_robot.character import Character
from tcbi_bringup.emulated_robot.drawing import Drawing, Hip

STEP_S = 5e-4
GRAVITY = 9.81
CONTACT = {"solref": "-20000 -200", "solimp": "0.95 0.99 0.0005 0.5 2"}
IMPRATIO = 200
ROLLING_FRICTION = 0.0001  # m
HORN_STOP = 1.05  # of the joint range, where the mechanical stop is
SLIMMER = 0.8  # of the drawn link radius, so that the rubber cap and not the link's end meets the ground


@dataclass(frozen=True)
class Box:
    """A box on the ground: centre (m), full edges (m), yaw (rad), in the plane's frame."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float = 0.0


@dataclass(frozen=True)
class Scene:
    """The ground that the experimenter sets up: its tilt in the world, Ry(pitch) Rx(roll), and what lies on it."""

    slope_roll: float = 0.0  # rad
    slope_pitch: float = 0.0  # rad
    blocks: tuple[Box, ...] = ()
    yaw: float = 0.0  # rad, heading in which the robot is put down


@dataclass
class Load:
    """A body screwed to the trunk: mass (kg), centre (m, in `base_link`), full edges (m)."""

    mass: float
    center: tuple[float, float, float]
    size: tuple[float, float, float]


@dataclass
class Build:
    """What differs from the drawing mechanically; a hidden effect may change it before the robot is built."""

    joint_damping: float  # N m s/rad at the leg's side of the gear
    joint_armature: float  # kg m^2 at the leg's side of the gear
    loads: list[Load]
    gap: float = 0.0  # rad between motor and leg
    rotor: float = 0.0  # kg m^2 at the output shaft, beside the drawing's
    compliance: float = 0.0  # rad/(N m) between motor and leg
    gain_factor: dict[int, float] = field(default_factory=dict)  # of single servos
    horn_offset: dict[str, float] = field(default_factory=dict)  # rad by joint: true angle less the servo's
    shin_bend: dict[str, float] = field(default_factory=dict)  # rad by leg, sideways at the knee
    shin_length: dict[str, float] = field(default_factory=dict)  # by leg, over the drawing's
    imu_tilt: tuple[float, float] = (0.0, 0.0)  # rad, roll and pitch against the trunk
    slope: tuple[float, float] = (0.0, 0.0)  # rad, roll and pitch of the ground beyond the scene's
    contact: Mapping[str, str] = field(default_factory=lambda: CONTACT)
    feet_decide: bool = False  # on friction, in place of the greater of foot's and ground's


def gravity(scene: Scene) -> tuple[float, float, float]:
    """Gravity (m/s^2) in the frame of the tilted plane."""
    cr, sr = math.cos(scene.slope_roll), math.sin(scene.slope_roll)
    cp, sp = math.cos(scene.slope_pitch), math.sin(scene.slope_pitch)
    return (GRAVITY * sp, -GRAVITY * sr * cp, -GRAVITY * cr * cp)


def tilted(roll: float, pitch: float) -> tuple[float, float, float, float]:
    """w x y z of Ry(pitch) Rx(roll), angles in rad."""
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return (cr * cp, sr * cp, cr * sp, -sr * sp)


def compile_model(drawing: Drawing, character: Character, build: Build, scene: Scene) -> mujoco.MjModel:
    """The compiled robot on its ground; joints in the contract's order after the free joint of `base_link`."""
    return mujoco.MjModel.from_xml_string(ET.tostring(_document(drawing, character, build, scene), encoding="unicode"))


def _document(drawing: Drawing, character: Character, build: Build, scene: Scene) -> ET.Element:
    root = ET.Element("mujoco", model="emulated_hexapod")
    _add(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="true")
    _add(
        root,
        "option",
        timestep=STEP_S,
        gravity=gravity(scene),
        integrator="implicitfast",
        cone="elliptic",
        impratio=IMPRATIO,
        jacobian="sparse",  # the same physics as dense, a quarter faster here
        tolerance=1e-7,
    )
    default = _add(root, "default")
    stop = HORN_STOP * drawing.joint_range
    _add(default, "joint", damping=build.joint_damping, armature=build.joint_armature, range=(-stop, stop))
    friction = (character.friction, character.turning, ROLLING_FRICTION)
    _add(default, "geom", condim="4", friction=friction, **build.contact)
    world = _add(root, "worldbody")
    _ground(world, scene)
    trunk = _trunk(world, drawing, character, build)
    for leg, hip in drawing.hips.items():
        _leg(trunk, leg, hip, drawing, character.mass / drawing.mass, build)
    sensor = _add(root, "sensor")
    _add(sensor, "gyro", site="imu_link")
    _add(sensor, "accelerometer", site="imu_link")
    for leg in drawing.hips:
        _add(sensor, "touch", site=f"{leg}_switch")
    return root


def _ground(world: ET.Element, scene: Scene) -> None:
    _add(world, "geom", name="ground", type="plane", size=(0, 0, 1), **_GROUND)
    for i, block in enumerate(scene.blocks):
        body = _add(world, "body", pos=block.center, euler=(0, 0, block.yaw))
        _add(body, "geom", name=f"block_{i}", type="box", size=[edge / 2 for edge in block.size], **_GROUND)


def _trunk(world: ET.Element, drawing: Drawing, character: Character, build: Build) -> ET.Element:
    trunk = _add(world, "body", name="base_link")
    _add(trunk, "freejoint")
    _add(trunk, "site", name="imu_link", pos=drawing.imu_position, quat=tilted(*build.imu_tilt))
    mass = drawing.trunk_mass * character.mass / drawing.mass
    _add(trunk, "geom", name="trunk", type="box", size=[e / 2 for e in drawing.trunk_size], mass=mass, **_SOLID)
    for i, load in enumerate(build.loads):
        carried = _add(trunk, "body", name=f"load_{i}", pos=load.center)
        _add(carried, "geom", type="box", size=[e / 2 for e in load.size], mass=load.mass, **_SOLID)
    return trunk


def _leg(trunk: ET.Element, leg: str, hip: Hip, drawing: Drawing, mass_scale: float, build: Build) -> None:
    """Coxa, femur, tibia and foot; in each link's frame x points outward and z up at zero."""
    forward = (0, 0, -1) if hip.direction > 0 else (0, 0, 1)
    outward = (0, -1, 0)
    elevation, tilt = drawing.femur_elevation, drawing.tibia_tilt
    elbow = (drawing.coxa_length, 0.0, 0.0)
    knee = (drawing.femur_length * math.cos(elevation), 0.0, drawing.femur_length * math.sin(elevation))
    shin, bend = drawing.tibia_length * build.shin_length.get(leg, 1.0), build.shin_bend.get(leg, 0.0)
    down = shin * math.cos(tilt)
    foot = (shin * math.sin(tilt), -down * math.sin(bend), -down * math.cos(bend))
    radius = SLIMMER * drawing.link_radius

    def link(name: str, parent: ET.Element, start: _Vector, axis: _Vector, end: _Vector, mass: float) -> ET.Element:
        slipped = build.horn_offset.get(f"{leg}_{name}", 0.0)
        turn = (0, 0, hip.direction + slipped * axis[2]) if name == "coxa" else (0, slipped * axis[1], 0)
        collision = _HOLLOW if name == "coxa" else _SOLID
        body = _add(parent, "body", name=f"{leg}_{name}", pos=start, euler=turn)
        _add(body, "joint", name=f"{leg}_{name}", axis=axis)
        _add(body, "geom", type="capsule", fromto=(0, 0, 0, *end), size=radius, mass=mass * mass_scale, **collision)
        return body

    coxa = link("coxa", trunk, hip.position, forward, elbow, drawing.coxa_mass)
    femur = link("femur", coxa, elbow, outward, knee, drawing.femur_mass)
    tibia = link("tibia", femur, knee, outward, foot, drawing.tibia_mass)
    own = {"priority": "1"} if build.feet_decide else {}
    _add(tibia, "geom", name=f"{leg}_foot", type="sphere", pos=foot, size=drawing.foot_radius, mass=0, **_SOLID, **own)
    _add(tibia, "site", name=f"{leg}_switch", pos=foot, size=1.3 * drawing.foot_radius)


_Vector = tuple[float, float, float]
_GROUND = {"contype": "1", "conaffinity": "0"}
_SOLID = {"contype": "2", "conaffinity": "3"}  # meets the ground and the robot's other parts
_HOLLOW = {"contype": "0", "conaffinity": "0"}


def _add(parent: ET.Element, tag: str, **attributes: str | float | Sequence[float]) -> ET.Element:
    """A child element; numbers are written so that they read back as the same bits."""
    text = {}
    for name, value in attributes.items():
        if isinstance(value, str):
            text[name] = value
        else:
            numbers = value if isinstance(value, Sequence) else [value]
            text[name] = " ".join(repr(float(v)) for v in numbers)
    return ET.SubElement(parent, tag, text)
