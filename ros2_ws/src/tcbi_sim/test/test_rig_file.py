"""A user's own robot, described by its MJCF or URDF and a short TOML, is a rig like any other."""

import re

import mujoco
import numpy as np
import pytest

from tcbi_sim.effects import candidates
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.mjcf import materialise
from tcbi_sim.model import base_model
from tcbi_sim.rig_file import RigFileError, read_rig, set_everywhere
from tcbi_sim.rig_settings import Setting
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
    scenario = Scenario("none", 6.0, settle=0.0, initial_joint_position=(0.0,), constants=tuple(constants.items()))
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


@pytest.mark.parametrize("sets", ["damping", "inertia", "lag"])
def test_a_recording_with_a_constant_has_its_bits_also_beside_one_without(folder, sets):
    places = {"inertia": 'bodies = ["arm"]\n'}.get(sets, "")
    (folder / "my_arm.toml").write_text(TOML.replace('sets = "damping"\n', f'sets = "{sets}"\n{places}'))
    commands = [Commands(np.zeros(1), np.array([[0.5]]), 0.0)]
    scenarios = [Scenario("none", 0.5, settle=0.0, constants=given) for given in ((("drag", 0.3),), ())]

    def run(chosen):
        parameters = np.array([[4.0, 1.0]])
        return simulate(base_model("my_arm"), parameters, chosen, commands=commands * len(chosen)).joint_position[0]

    apart = np.concatenate([run([scenario]) for scenario in scenarios])
    np.testing.assert_allclose(run(scenarios), apart, rtol=0, atol=1e-12)


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
        ('["hinge"]', '["left/hinge"]', "joints: got 'left/hinge', allowed are names without /"),
        ('["arm"]', '["leg"]', r"parameters.load.bodies: got \['leg'\]"),
        ('sets = "mass"', 'sets = "weight"', "parameters.load.sets: got 'weight', allowed is one of gain"),
        ("low = 0.5", "low = 5.0", "parameters.load: parameter 'load'"),
        ("high = 20.0", "hihg = 20.0", "unknown key 'hihg'; parameters.gain lacks high"),
        ("model =", "commands = 'speed'\nmodel =", "commands: got 'speed'"),
        ("model =", "rate = -1\nmodel =", "rate: got -1"),
        ("model =", "posture = 'sit'\nmodel =", "posture: got 'sit', allowed is the name of a key frame.*none has one"),
        ("[par", "[posture]\nknee = 1.0\n[par", "posture: got {'knee': 1.0}, allowed is .*angles"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_each(folder, old, new, told):
    assert old in TOML
    (folder / "my_arm.toml").write_text(TOML.replace(old, new, 1))
    with pytest.raises(RigFileError, match=told):
        load_rig("my_arm")


@pytest.mark.parametrize(
    ("posture", "angle"),
    [("", 0.3), ("posture = 'low'", -0.2), ("[posture]\nhinge = 0.7", 0.7), ("[posture]", 0.0)],
    ids=("first key frame", "named key frame", "listed", "none listed"),
)
def test_it_rests_in_a_key_frame_or_as_listed(folder, posture, angle):
    frames = "<keyframe><key name='home' qpos='0.3'/><key name='low' qpos='-0.2'/></keyframe>"
    (folder / "arm.xml").write_text(re.sub("<keyframe>.*</keyframe>", frames, MJCF))
    where = "model =" if posture.startswith("posture") else "[par"
    (folder / "my_arm.toml").write_text(TOML.replace(where, f"{posture}\n{where}", 1))
    assert load_rig("my_arm").at_rest == pytest.approx([angle])


MOTOR = '<actuator><motor joint="hinge"/></actuator>'
SERVO = '<actuator><position joint="hinge" kp="4"/></actuator>'


def actuated(folder, actuator, commands="torque", servo=""):
    """The rig of an arm with an actuator of its own, whose mass is its only parameter."""
    (folder / "arm.xml").write_text(MJCF.replace("<keyframe>", f"{actuator}<keyframe>"))
    load = TOML[TOML.index("[parameters.load]") :]
    (folder / "my_arm.toml").write_text(f"model = 'arm.xml'\ncommands = '{commands}'\n{servo}\n{load}")
    return load_rig("my_arm")


@pytest.mark.parametrize(
    ("actuator", "commands", "told"),
    [
        (MOTOR.replace("/></", ' gear="100"/></'), "torque", "'hinge' has gear 100, allowed is 1.*remove gear"),
        (MOTOR.replace("motor", "general gainprm='5'"), "torque", "gainprm 5, allowed is 1.*make it a motor"),
        (SERVO.replace("/></", ' gear="2"/></'), "position", "has gear 2, allowed is 1"),
    ],
    ids=("gear", "gain", "gear of a servo"),
)
def test_an_actuator_that_changes_commands_is_refused(folder, actuator, commands, told):
    with pytest.raises(RigFileError, match=told):
        actuated(folder, actuator, commands)


def test_an_actuator_that_takes_commands_as_they_are_stays_and_one_that_does_not_is_replaced_by_a_servo(folder):
    assert actuated(folder, MOTOR).kind == "torque"
    assert actuated(folder, SERVO, "position").kind == "position"
    geared = SERVO.replace("/></", ' gear="2" ctrlrange="-0.1 0.1"/></')
    actuated(folder, geared, "position", "[servo]\ngain = 40.0")
    angle, _ = rest(base_model("my_arm"), [1.0])
    assert 40.0 * (0.5 - angle) == pytest.approx(0.3 * 9.81 * 0.1 * np.sin(angle), abs=1e-3)


def test_a_joints_range_is_in_radians_whatever_the_models_unit(folder):
    for unit, ends in (("degree", "-110 60"), ("radian", "-1.9198621772 1.0")):
        model = MJCF.replace("<worldbody>", f'<compiler angle="{unit}"/><worldbody>')
        (folder / "arm.xml").write_text(model.replace('type="hinge"', f'type="hinge" range="{ends}"'))
        assert read_rig(folder / "my_arm.toml").joint_range == pytest.approx(np.radians(110))


NUMBERS = 'unit = "1"\nlow = 0.1\nhigh = 2.0\nnominal = 1.0\n'


def offered(folder, *parameters, limit=True):
    """Names of the effects that are offered for an arm with these parameters, each `NAME` and what it sets."""
    sections = "".join(f"[parameters.{n}]\nsets = '{q}'\n{NUMBERS}" for n, q in parameters)
    servo = "[servo]\ngain = 4.0\n" + ("torque_limit = 1.0\n" if limit else "")
    (folder / "my_arm.toml").write_text(f"model = 'arm.xml'\n{servo}{sections}")
    return {u.effect.name for u in candidates(read_rig(folder / "my_arm.toml"))}


@pytest.mark.parametrize(
    ("quantity", "effect"),
    [
        ("torque_limit", "torque_saturation"),
        ("damping", "viscous_damping"),
        ("friction", "coulomb_friction"),
        ("gain", "gravity_droop"),
        ("armature", "rotor_inertia"),
    ],
)
def test_an_effect_is_not_offered_where_a_parameter_of_any_name_sets_the_same_at_every_joint(folder, quantity, effect):
    assert effect in offered(folder, ("drag", "lag"))
    assert effect not in offered(folder, ("drag", quantity))


def test_an_effect_is_offered_where_a_parameter_sets_the_same_at_some_joints_only():
    rig = load_rig("double_pendulum")
    first, second = (Setting("rotor", "armature", (joint,)) for joint in rig.joint_names)
    assert set_everywhere([first], rig.joint_names) == frozenset()
    assert set_everywhere([first, second], rig.joint_names) == {"armature"} == rig.own_quantities


def test_effects_on_the_torque_limit_are_offered_only_where_there_is_one(folder):
    both = {"torque_saturation", "speed_limit"}
    assert both <= offered(folder, ("drag", "lag"))
    assert not both & offered(folder, ("drag", "lag"), limit=False)
    for name in ("so101_arm", "double_pendulum"):
        assert not both & {u.effect.name for u in candidates(load_rig(name))}


def test_a_torque_limit_that_nothing_has_cannot_be_a_parameter(folder):
    with pytest.raises(RigFileError, match=r"most: 'hinge' has no torque limit.*give \[servo\] with torque_limit"):
        offered(folder, ("most", "torque_limit"), limit=False)


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
    saved = ModelStore(tmp_path).save(base_model(rig).with_effect("viscous_damping"))
    own = materialise(saved)
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "models" / saved.version / "model.xml"))
    np.testing.assert_allclose(exported.dof_damping, own.dof_damping, rtol=1e-4)
    assert (own.dof_damping > rig.build(0).compile().dof_damping).all()
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
