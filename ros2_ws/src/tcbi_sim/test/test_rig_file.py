"""A user's own robot, described by its MJCF or URDF and a short TOML, is a rig like any other."""

import mujoco
import numpy as np
import pytest

from tcbi_sim.effects import candidates
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.mjcf import materialise
from tcbi_sim.model import base_model
from tcbi_sim.rig_file import RigFileError, read_rig
from tcbi_sim.rigs import RIGS, load_rig, rig_names
from tcbi_sim.store import ModelStore

MJCF = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="rod" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.3"/>
    </body>
  </worldbody>
  <keyframe><key qpos="0.5"/></keyframe>
</mujoco>
"""
URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="arm">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="5"/></joint>
</robot>
"""
TOML = """
model = "arm.xml"
joints = ["hinge"]
[servo]
gain = 4.0
[parameters.gain]
unit = "N m/rad"
low = 1.0
high = 20.0
nominal = 4.0
scale = "log"
[parameters.load]
sets = "mass"
bodies = ["arm"]
factor = true
unit = "1"
low = 0.5
high = 3.0
nominal = 1.0
[constants.drag]
sets = "damping"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "arm.xml").write_text(MJCF)
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "my_arm.toml").write_text(TOML)
    monkeypatch.setenv("TCBI_RIGS", str(tmp_path))
    return tmp_path


def rest(model, values, target=0.5, **constants):
    """Where the arm comes to rest, rad."""
    scenario = Scenario("none", 6.0, settle=0.0, constants=tuple(constants.items()))
    out = simulate(model, np.array([values]), [scenario], commands=[Commands(np.zeros(1), np.array([[target]]), 0.0)])
    return float(out.joint_position[0, 0, -1, 0]), out.joint_position[0, 0, :, 0]


@pytest.mark.parametrize("file", ["arm.xml", "arm.urdf"])
def test_an_arm_from_the_users_own_file_rests_where_servo_and_weight_balance(folder, file):
    (folder / "my_arm.toml").write_text(TOML.replace("arm.xml", file))
    for gain, load in ((4.0, 1.0), (8.0, 2.0), (2.0, 1.0)):
        angle, _ = rest(base_model("my_arm"), [gain, load], drag=0.1)
        assert gain * (0.5 - angle) == pytest.approx(load * 0.3 * 9.81 * 0.1 * np.sin(angle), abs=1e-3)


def test_a_recordings_constant_is_written_and_without_it_the_model_file_counts(folder):
    model = base_model("my_arm")
    _, as_filed = rest(model, [4.0, 1.0])
    _, same = rest(model, [4.0, 1.0], drag=0.1)
    _, slow = rest(model, [4.0, 1.0], drag=1.0)
    np.testing.assert_array_equal(as_filed, same)
    assert abs(slow[20] - as_filed[20]) > 0.05


def test_the_users_rig_has_a_version_0_that_can_be_saved_with_an_effect(folder):
    store = ModelStore(folder / "store")
    assert "my_arm" in rig_names() and "my_arm-v0" in store.versions()
    saved = store.save(store.load(rig="my_arm").with_effect("backlash"))
    assert store.load(rig="my_arm").effects == ("backlash",) and saved.version == "my_arm-v1"
    mujoco.MjModel.from_xml_path(str(store.models / "my_arm-v1" / "model.xml"))


def test_a_changed_file_is_read_again(folder):
    assert load_rig("my_arm").rate == 50.0
    (folder / "my_arm.toml").write_text("rate = 100\n" + TOML)
    assert load_rig("my_arm").rate == 100.0


def test_a_motion_may_begin_with_speed(folder):
    free, at, speed = (("drag", 0.0),), (0.2,), (3.0,)
    start = Scenario("none", 0.1, settle=0.0, initial_joint_position=at, initial_joint_velocity=speed, constants=free)
    held = Commands(np.zeros(1), np.array([[0.2]]), 0.0)
    out = simulate(base_model("my_arm"), np.array([[4.0, 1.0]]), [start], commands=[held])
    assert out.joint_position[0, 0, 1, 0] - 0.2 == pytest.approx(3.0 / 50, rel=0.2)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"arm.xml"', '"leg.xml"', "model: got 'leg.xml'"),
        ('["hinge"]', '["hinge", "knee"]', "no hinge 'knee'; it has hinge"),
        ("gain = 4.0\n[par", "[par", r"give \[servo\] with gain"),
        ('["arm"]', '["leg"]', r"parameters.load.bodies: got \['leg'\]"),
        ('sets = "mass"', 'sets = "weight"', "parameters.load.sets: got 'weight', allowed is one of gain"),
        ("low = 0.5", "low = 5.0", "parameters.load: parameter 'load'"),
        ("high = 20.0", "hihg = 20.0", "unknown key 'hihg'; parameters.gain lacks high"),
        ("model =", "commands = 'speed'\nmodel =", "commands: got 'speed'"),
        ("model =", "rate = -1\nmodel =", "rate: got -1"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_each(folder, old, new, told):
    assert old in TOML
    (folder / "my_arm.toml").write_text(TOML.replace(old, new, 1))
    with pytest.raises(RigFileError, match=told):
        load_rig("my_arm")


def test_a_model_that_mujoco_refuses_is_refused_in_one_line(folder):
    (folder / "arm.xml").write_text(MJCF.replace('mass="0.3"', 'mass="-1"'))
    with pytest.raises(RigFileError, match="MuJoCo"):
        read_rig(folder / "my_arm.toml")


def test_a_built_in_name_is_not_taken_over(folder):
    (folder / "my_arm.toml").rename(folder / "hexapod.toml")
    with pytest.raises(RigFileError, match="rename the file"):
        load_rig("hexapod")


@pytest.mark.parametrize("name", ["so101_arm", "double_pendulum"])
def test_described_rigs_come_with_the_package_and_are_saved_with_effects(name, tmp_path):
    """Their shapes have no names, as in many users' files."""
    rig = load_rig(name)
    assert name in RIGS and candidates(rig)
    saved = ModelStore(tmp_path).save(base_model(rig).with_effect("rotor_inertia"))
    own = materialise(saved)
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "models" / saved.version / "model.xml"))
    np.testing.assert_allclose(exported.dof_armature, own.dof_armature, rtol=1e-4)
    assert (own.dof_armature > rig.build(0).compile().dof_armature).all()
    assert exported.ngeom == own.ngeom > 0


def test_the_so101_droops_only_where_it_carries_weight():
    """Static angles at the pose of the recordings, from the maker's masses and 11 N m/rad at every joint."""
    rig = load_rig("so101_arm")
    model = base_model(rig)
    for joint in rig.joint_names:
        model = model.with_effect(f"gravity_droop:{joint}")
    posture = (0.0, 0.0, 0.5, 0.0, 0.0, 0.5)
    scenario = Scenario("none", 4.0, settle=0.0, initial_joint_position=posture)
    commands = Commands(np.zeros(1), np.array([posture]), 0.0)
    values = [[0.1] + [1 / 11] * 6]
    out = simulate(model, np.array(values), [scenario], commands=[commands], timestep=0.01)
    droop = np.degrees(out.joint_position[0, 0, -1] - posture)
    assert droop[1:4] == pytest.approx([2.5, 2.1, 0.5], abs=0.2)
    assert np.abs(droop[[0, 4, 5]]).max() < 0.05
