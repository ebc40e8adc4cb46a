"""A URDF of a rig, made from the compiled MuJoCo model, so that RViz and Foxglove draw what is simulated.

One link per body, one revolute joint per hinge, one fixed frame per site; inertials and collision shapes are those of
the model, joint limits the range of the commands, which ends before the model's mechanical stops. Links stand where
MuJoCo puts the bodies: frames are body frames, moved to the hinge's anchor where the two differ. MuJoCo capsules become
a cylinder and two spheres, since URDF has no capsule.

    text = urdf(spec.compile(), "hexapod", velocity=5.0, reach=math.pi / 6)
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator

import mujoco
import numpy as np

from tcbi_sim.errors import SimError
from tcbi_sim.rigs import load_rig

_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_BOX),
    int(mujoco.mjtGeom.mjGEOM_SPHERE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
}


class DescriptionError(SimError):
    """The rig holds something that a URDF cannot say."""


def urdf(model: mujoco.MjModel, name: str, velocity: float, root: str | None = None, reach: float = np.inf) -> str:
    """The URDF of the tree below a top-level body.

    Args:
      model: the compiled rig; its `qpos0` is the zero of every joint.
      name: of the robot.
      velocity: rad/s, the joints' speed limit, which a MuJoCo model does not hold.
      root: name of a child of the world; by default the body with the free joint, or the first one.
      reach: rad either side of zero that joints are commanded to, where the model's own limits lie behind it.

    Raises:
      DescriptionError: a body has joints other than one hinge, a shape that URDF lacks, or no name.
    """
    robot = ET.Element("robot", name=name)
    top = _root(model, root)
    floating = model.body_jntnum[top] > 0 and model.jnt_type[model.body_jntadr[top]] == mujoco.mjtJoint.mjJNT_FREE
    if not floating:
        ET.SubElement(robot, "link", name="world")
    bodies = [body for body in range(1, model.nbody) if model.body_rootid[body] == top]  # parents come first
    for body in bodies:
        link = ET.SubElement(robot, "link", name=_name(model.body(body).name, "body", body))
        _inertial(link, model, body)
        _shapes(link, model, body)
        if body != top or not floating:
            _joint(robot, model, body, velocity, reach)
    for site in range(model.nsite):
        if model.site_bodyid[site] in bodies:
            _frame(robot, model, site)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def describe_rig(name: str) -> str:
    """The URDF of a built-in rig at its nominal parameters."""
    rig = load_rig(name)
    return urdf(rig.build(0).compile(), rig.name, rig.speed_limit, reach=rig.joint_range)


def _root(model: mujoco.MjModel, root: str | None) -> int:
    if root is not None:
        return int(model.body(root).id)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return int(model.jnt_bodyid[free[0]]) if free.size else 1


def _name(name: str, what: str, index: int) -> str:
    if not name:
        raise DescriptionError(f"{what} {index} of the rig has no name; a URDF needs one for every link and joint")
    return name


def _hinge(model: mujoco.MjModel, body: int) -> int | None:
    count = int(model.body_jntnum[body])
    if count == 0:
        return None
    joint = int(model.body_jntadr[body])
    if count > 1 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        raise DescriptionError(
            f"body {model.body(body).name!r} has {count} joint(s), the first of type {int(model.jnt_type[joint])}; "
            "a URDF link can have one hinge: describe the rig without this effect"
        )
    return joint


def _anchor(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Origin of the link's frame in the body's frame, m: the hinge's anchor."""
    return np.array(model.jnt_pos[model.body_jntadr[body]]) if model.body_jntnum[body] else np.zeros(3)


def _joint(robot: ET.Element, model: mujoco.MjModel, body: int, velocity: float, reach: float) -> None:
    hinge, parent = _hinge(model, body), int(model.body_parentid[body])
    name = f"{model.body(body).name}_fixed" if hinge is None else _name(model.joint(hinge).name, "joint", hinge)
    element = ET.SubElement(robot, "joint", name=name, type="fixed" if hinge is None else "revolute")
    rotation = _matrix(model.body_quat[body])
    position = model.body_pos[body] + rotation @ _anchor(model, body) - _anchor(model, parent)
    _origin(element, position, model.body_quat[body])
    ET.SubElement(element, "parent", link=model.body(parent).name)
    ET.SubElement(element, "child", link=model.body(body).name)
    if hinge is None:
        return
    ET.SubElement(element, "axis", xyz=_text(model.jnt_axis[hinge]))
    lower, upper = model.jnt_range[hinge] if model.jnt_limited[hinge] else (-np.pi, np.pi)
    lower, upper = max(lower, -reach), min(upper, reach)
    limit = {"lower": lower, "upper": upper, "effort": _effort(model, hinge), "velocity": velocity}
    ET.SubElement(element, "limit", {key: f"{value:.9g}" for key, value in limit.items()})


def _effort(model: mujoco.MjModel, joint: int) -> float:
    """Largest torque of the joint's actuator, N m; 100 where the model sets no limit."""
    for actuator in range(model.nu):
        if model.actuator_trnid[actuator, 0] == joint and model.actuator_forcelimited[actuator]:
            return float(np.abs(model.actuator_forcerange[actuator]).max())
    return float(np.abs(model.jnt_actfrcrange[joint]).max()) if model.jnt_actfrclimited[joint] else 100.0


def _inertial(link: ET.Element, model: mujoco.MjModel, body: int) -> None:
    if model.body_mass[body] <= 0:
        return
    element = ET.SubElement(link, "inertial")
    offset = model.body_ipos[body] - _anchor(model, body)
    _origin(element, offset, model.body_iquat[body])
    ET.SubElement(element, "mass", value=f"{model.body_mass[body]:.6g}")
    ixx, iyy, izz = (f"{value:.6g}" for value in model.body_inertia[body])
    ET.SubElement(element, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")


def _shapes(link: ET.Element, model: mujoco.MjModel, body: int) -> None:
    start, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    for geom in range(start, start + count):
        if int(model.geom_type[geom]) not in _SHAPES:
            raise DescriptionError(f"geom {geom} of {link.get('name')!r} is no box, sphere, capsule or cylinder")
        solid = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        for kind in ("visual", "collision") if solid else ("visual",):
            for offset, shape in _primitives(model, geom):
                _shape(link, kind, model, geom, offset, shape)


def _primitives(model: mujoco.MjModel, geom: int) -> Iterator[tuple[float, dict[str, dict[str, str]]]]:
    """(offset along the geom's z, URDF geometry) of the parts that make up a geom."""
    size, kind = model.geom_size[geom], mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        yield 0.0, {"box": {"size": _text(2 * size)}}
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        yield 0.0, {"sphere": {"radius": f"{size[0]:.6g}"}}
    else:
        yield 0.0, {"cylinder": {"radius": f"{size[0]:.6g}", "length": f"{2 * size[1]:.6g}"}}
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            yield float(size[1]), {"sphere": {"radius": f"{size[0]:.6g}"}}
            yield -float(size[1]), {"sphere": {"radius": f"{size[0]:.6g}"}}


def _shape(
    link: ET.Element, kind: str, model: mujoco.MjModel, geom: int, offset: float, shape: dict[str, dict[str, str]]
) -> None:
    element = ET.SubElement(link, kind)
    body = int(model.geom_bodyid[geom])
    anchor = _anchor(model, body)
    along = _matrix(model.geom_quat[geom])[:, 2] * offset
    _origin(element, model.geom_pos[geom] - anchor + along, model.geom_quat[geom])
    geometry = ET.SubElement(element, "geometry")
    for tag, attributes in shape.items():
        ET.SubElement(geometry, tag, attributes)
    if kind == "visual":
        material = ET.SubElement(element, "material", name=f"{model.body(body).name}_{geom}")
        ET.SubElement(material, "color", rgba=_text(model.geom_rgba[geom]))


def _frame(robot: ET.Element, model: mujoco.MjModel, site: int) -> None:
    """A massless link at a site, such as the IMU's or a foot's frame."""
    name, body = _name(model.site(site).name, "site", site), int(model.site_bodyid[site])
    if any(link.get("name") == name for link in robot.iter("link")):
        raise DescriptionError(f"site {name!r} has the name of a body; a URDF needs distinct names")
    ET.SubElement(robot, "link", name=name)
    joint = ET.SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
    _origin(joint, model.site_pos[site] - _anchor(model, body), model.site_quat[site])
    ET.SubElement(joint, "parent", link=model.body(body).name)
    ET.SubElement(joint, "child", link=name)


def _origin(element: ET.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    ET.SubElement(element, "origin", xyz=_text(position), rpy=_text(_roll_pitch_yaw(quaternion)))


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    return matrix.reshape(3, 3)


def _roll_pitch_yaw(quaternion: np.ndarray) -> np.ndarray:
    """URDF's fixed-axis angles (rad), exact at pitch = +-pi/2 too, where a capsule along x or a lying box stands."""
    m = _matrix(quaternion)
    pitch = np.arctan2(-m[2, 0], np.hypot(m[0, 0], m[1, 0]))
    if np.hypot(m[0, 0], m[1, 0]) < 1e-9:
        return np.array([np.arctan2(-m[1, 2], m[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])


def _text(values: np.ndarray) -> str:
    return " ".join(f"{0.0 if abs(v) < 1e-12 else v:.9g}" for v in np.asarray(values, float))
