"""A described robot that stands free on the ground: what its file says of that, and what it adds to the robot's model.

The ground takes the place of planes that the model has of its own. Each foot is a sphere of the model and gets a
switch; the base gets an IMU and a tracker.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco

from tcbi_contract.names import IMU_FRAME
from tcbi_sim.ground import add_ground

EVERYTHING = 2**31 - 1  # collision bits
TORSIONAL, ROLLING = 0.005, 1e-4  # m, as MuJoCo has them by default
IMPEDANCE = (0.95, 0.99, 0.0005, 0.5, 2.0)  # solimp: firm ground
# rad, rad/s, m/s^2, m: of the hexapod's sensors
BODY_NOISE = {"attitude": 0.003, "angular_velocity": 0.01, "linear_acceleration": 0.08, "position": 0.001}
GROUND = {  # key: default and what it must be
    "sliding_friction": (0.8, "1, above 0"),
    "time_constant": (0.01, "s, above 0"),
    "contact_threshold": (1.0, "N, above 0"),
}


@dataclass(frozen=True)
class FreeBody:
    """A robot on the ground.

    Attributes:
      base: the body with the free joint.
      imu: a site on it; empty for its origin.
      feet: name and geom of each.
      legs: name of each and its joints.
      sliding_friction: between feet and ground.
      time_constant: s, of contacts.
      contact_threshold: N, from which a foot says that it stands.
    """

    base: str
    imu: str
    feet: tuple[tuple[str, str], ...]
    legs: tuple[tuple[str, tuple[str, ...]], ...]
    sliding_friction: float
    time_constant: float
    contact_threshold: float

    def add_to(self, spec: mujoco.MjSpec, blocks: int) -> None:
        """Put the robot of a spec on the ground and give it the sensors that every floating rig has."""
        for geom in [g for g in spec.worldbody.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]:
            spec.delete(geom)
        rubbing = (self.sliding_friction, TORSIONAL, ROLLING)
        add_ground(spec, blocks, EVERYTHING, rubbing, (self.time_constant, 1.0), IMPEDANCE)
        imu = self.imu or IMU_FRAME
        if not self.imu:
            spec.body(self.base).add_site(name=IMU_FRAME, size=[0.005] * 3)
        site = mujoco.mjtObj.mjOBJ_SITE
        for name, kind in (
            ("attitude", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
            ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
            ("accelerometer", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
        ):
            spec.add_sensor(name=name, type=kind, objtype=site, objname=imu)
        for name, geom in self.feet:
            foot, switch = spec.geom(geom), f"contact/{name}"
            sole = mujoco.mjtGeom.mjGEOM_SPHERE
            foot.parent.add_site(name=switch, type=sole, pos=foot.pos, size=[1.5 * foot.size[0], 0, 0], rgba=[0] * 4)
            spec.add_sensor(name=switch, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=site, objname=switch)
        spec.add_sensor(
            name="tracker", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=self.base
        )

    def of_rig(self, model: mujoco.MjModel, posture: dict[str, float]) -> dict[str, Any]:
        """What a rig has of it that stands in a posture, joint -> rad."""
        return {
            "floating": True,
            "has_imu": True,
            "base": self.base,
            "foot_names": tuple(name for name, _ in self.feet),
            "foot_geoms": tuple(geom for _, geom in self.feet),
            "legs": dict(self.legs),
            "contact_threshold": self.contact_threshold,
            "stand_height": self._stand_height(model, posture),
        }

    def _stand_height(self, model: mujoco.MjModel, posture: dict[str, float]) -> float:
        """Base above the ground (m) where the lowest foot touches it."""
        data = mujoco.MjData(model)
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0
        for joint, angle in posture.items():
            data.joint(joint).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        feet = [model.geom(geom).id for _, geom in self.feet]
        return float(-(data.geom_xpos[feet, 2] - model.geom_size[feet, 0]).min())


def read_free_body(
    content: dict[str, Any], spec: mujoco.MjSpec, joints: tuple[str, ...], fault: Callable[[str], None]
) -> FreeBody | None:
    """What a description says of the ground; None where its robot is fixed to the world.

    Args:
      content: of the TOML file.
      spec: of the model.
      joints: of the rig.
      fault: called with everything that is wrong.
    """
    free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    ground = content.get("ground")
    if ground is None:
        if free:
            fault("the model has a free joint: give [ground] and [feet], or remove the joint where the robot is fixed")
        return None
    if not isinstance(ground, dict) or set(ground) - {"imu", *GROUND}:
        fault(f"ground: got {ground!r}, allowed is a section with imu, {', '.join(GROUND)}")
        return None
    if len(free) != 1 or (spec.joints[0] is not free[0] and spec.joints[0].name != free[0].name):
        fault(f"ground: the model has {len(free)} free joints, allowed is one, of its first body that moves")
        return None
    numbers = {key: _number(key, ground, fault) for key in GROUND}
    imu = ground.get("imu", "")
    sites = [s.name for s in spec.sites]
    if imu and imu not in sites:
        fault(f"ground.imu: got {imu!r}, allowed is a site of the model: {', '.join(filter(None, sites)) or 'none'}")
    feet, legs = _feet(content.get("feet"), spec, fault), _legs(content.get("legs", {}), joints, fault)
    alone = [name for name, _ in feet if name not in dict(legs)] if legs else []
    if alone:
        fault(f"legs: no leg has the name of foot {', '.join(alone)}; a leg has its foot's, which tells its stance")
    return FreeBody(
        base=free[0].parent.name,
        imu=str(imu),
        feet=feet,
        legs=legs,
        **numbers,
    )


def _number(key: str, section: dict[str, Any], fault: Callable[[str], None]) -> float:
    default, allowed = GROUND[key]
    value = section.get(key, default)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    fault(f"ground.{key}: got {value!r}, allowed is a number ({allowed})")
    return default


def _feet(feet: Any, spec: mujoco.MjSpec, fault: Callable[[str], None]) -> tuple[tuple[str, str], ...]:
    spheres = [g.name for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_SPHERE and g.name]
    if not isinstance(feet, dict) or not feet or not set(map(str, feet.values())) <= set(spheres):
        fault(
            f"feet: got {feet!r}, allowed is a section with a sphere of the model for each foot, out of "
            f"{', '.join(spheres) or 'none: give each foot a named geom of type sphere'}"
        )
        return ()
    return tuple(feet.items())


def _legs(legs: Any, joints: tuple[str, ...], fault: Callable[[str], None]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    if isinstance(legs, dict) and all(
        isinstance(leg, list) and leg and set(leg) <= set(joints) for leg in legs.values()
    ):
        return tuple((name, tuple(leg)) for name, leg in legs.items())
    fault(f"legs: got {legs!r}, allowed are lists of the joints")
    return ()
