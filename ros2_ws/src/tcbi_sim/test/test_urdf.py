"""The URDF says the same as the MuJoCo model, read by an independent forward kinematics."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcbi_contract.names import IMU_FRAME, JOINT_LIMIT, JOINTS, LEGS
from tcbi_sim.rigs import load_rig
from tcbi_sim.urdf import DescriptionError, describe_rig, urdf


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_rig("hexapod").build(0).compile()


@pytest.fixture(scope="module")
def robot(model: mujoco.MjModel) -> ET.Element:
    return ET.fromstring(urdf(model, "hexapod", velocity=6.0, reach=JOINT_LIMIT))


def origin(element: ET.Element) -> np.ndarray:
    """(4, 4) transform of an <origin>: fixed-axis roll, pitch, yaw, as the URDF specification says."""
    tag = element.find("origin")
    transform = np.eye(4)
    if tag is not None:
        transform[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in tag.get("rpy", "0 0 0").split()]).as_matrix()
        transform[:3, 3] = [float(v) for v in tag.get("xyz", "0 0 0").split()]
    return transform


def link_poses(robot: ET.Element, angles: dict[str, float]) -> dict[str, np.ndarray]:
    """(4, 4) pose of every link in the root link's frame."""
    joints = list(robot.iter("joint"))
    children = {joint.find("child").get("link") for joint in joints}
    (root,) = {link.get("name") for link in robot.iter("link")} - children
    poses = {root: np.eye(4)}
    while len(poses) < len(list(robot.iter("link"))):
        for joint in joints:
            parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
            if parent in poses and child not in poses:
                turn = np.eye(4)
                if joint.get("type") == "revolute":
                    axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
                    turn[:3, :3] = Rotation.from_rotvec(axis * angles[joint.get("name")]).as_matrix()
                poses[child] = poses[parent] @ origin(joint) @ turn
    return poses


def mujoco_pose(data: mujoco.MjData, model: mujoco.MjModel, name: str) -> np.ndarray:
    """(4, 4) pose of a body or site in the frame of base_link."""
    names = {model.site(i).name for i in range(model.nsite)}
    item = data.site(name) if name in names else data.body(name)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = item.xmat.reshape(3, 3), item.xpos
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = data.body("base_link").xmat.reshape(3, 3), data.body("base_link").xpos
    return np.linalg.inv(base) @ world


def test_links_stand_where_mujoco_puts_the_bodies(model, robot):
    rng = np.random.default_rng(1)
    data = mujoco.MjData(model)
    for _ in range(5):
        angles = dict(zip(JOINTS, rng.uniform(-0.5, 0.5, len(JOINTS)), strict=True))
        for joint, angle in angles.items():
            data.joint(joint).qpos = angle
        data.qpos[:7] = [0.3, -0.2, 0.1, *np.roll(Rotation.random(random_state=2).as_quat(), 1)]
        mujoco.mj_forward(model, data)
        poses = link_poses(robot, angles)
        assert {f"{leg}_foot" for leg in LEGS} | {IMU_FRAME, "base_link"} <= set(poses)
        for name, pose in poses.items():
            np.testing.assert_allclose(pose, mujoco_pose(data, model, name), atol=1e-7, err_msg=name)


def test_centre_of_mass_and_inertia_are_the_models(model, robot):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    poses = link_poses(robot, dict.fromkeys(JOINTS, 0.0))
    mass, moment, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    for link in robot.iter("link"):
        element = link.find("inertial")
        if element is None:
            continue
        pose, m = poses[link.get("name")] @ origin(element), float(element.find("mass").get("value"))
        tensor = np.diag([float(element.find("inertia").get(f"i{a}{a}")) for a in "xyz"])
        center = pose[:3, 3]
        mass, moment = mass + m, moment + m * center
        inertia += pose[:3, :3] @ tensor @ pose[:3, :3].T + m * (center @ center * np.eye(3) - np.outer(center, center))
    base = data.body("base_link")
    assert mass == pytest.approx(model.body("base_link").subtreemass[0], rel=1e-5)
    center = base.xmat.reshape(3, 3).T @ (data.subtree_com[base.id] - base.xpos)
    np.testing.assert_allclose(moment / mass, center, atol=1e-6)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(inertia, full[3:6, 3:6], rtol=1e-4, atol=1e-8)


def test_joints_bear_the_contracts_names_limits_and_strength(model, robot):
    revolute = [joint for joint in robot.iter("joint") if joint.get("type") == "revolute"]
    assert tuple(joint.get("name") for joint in revolute) == JOINTS
    for joint in revolute:
        limit = joint.find("limit")
        assert [float(limit.get(end)) for end in ("lower", "upper")] == pytest.approx([-JOINT_LIMIT, JOINT_LIMIT])
        assert float(limit.get("effort")) == pytest.approx(model.actuator(joint.get("name")).forcerange[1])
        assert float(limit.get("velocity")) == 6.0


@pytest.mark.parametrize("rig", ["hexapod", "servo_bench"])
def test_a_rig_is_described_with_the_range_of_its_commands(rig):
    limits = [joint.find("limit") for joint in ET.fromstring(describe_rig(rig)).iter("joint")]
    ends = [[float(limit.get(end)) for end in ("lower", "upper")] for limit in limits if limit is not None]
    reach = load_rig(rig).joint_range
    np.testing.assert_allclose(ends, [[-reach, reach]] * len(load_rig(rig).joint_names))


def test_every_solid_geom_has_a_collision_shape_of_its_size(model, robot):
    boxes = [shape for link in robot.iter("link") for shape in link.findall("collision/geometry/box")]
    assert [float(v) for v in boxes[0].get("size").split()] == pytest.approx(list(2 * model.geom("trunk").size))
    cylinders = [shape for link in robot.iter("link") for shape in link.findall("collision/geometry/cylinder")]
    assert len(cylinders) == len(JOINTS)
    assert float(cylinders[0].get("length")) == pytest.approx(2 * model.geom("lf_coxa").size[1], rel=1e-5)


def test_a_rig_that_stands_on_a_bench_is_described_too():
    robot = ET.fromstring(urdf(load_rig("servo_bench").build(0).compile(), "servo_bench", velocity=6.0))
    (joint,) = robot.iter("joint")
    assert (joint.get("name"), joint.find("parent").get("link"), joint.find("child").get("link")) == (
        "servo",
        "world",
        "arm",
    )


def test_two_hinges_on_one_body_are_refused_with_a_reason():
    spec = load_rig("hexapod").build(0)
    spec.body("lf_tibia").add_joint(name="play", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    with pytest.raises(DescriptionError, match=r"lf_tibia.*2 joint"):
        urdf(spec.compile(), "hexapod", velocity=6.0)
