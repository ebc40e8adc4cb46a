"""A described robot that stands free on the ground, from its logs to the effect that its model lacks."""

from pathlib import Path

import numpy as np
import pytest
from quadruped import DESCRIPTION, JOINTS, LEGS, MAPPING, POSTURE, RATE, mjcf, motions, write_log

from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.locate import joint_cells
from tcbi_infer.compare.replicates import repeats
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import EFFECT
from tcbi_infer.diagnose.motions import standard_motions
from tcbi_infer.diagnose.settings import QUICK
from tcbi_infer.errors import MappingError
from tcbi_infer.importer import read_log
from tcbi_infer.mapping import load_mapping
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario, roll_pitch_yaw
from tcbi_sim.model import base_model
from tcbi_sim.rig_file import RigFileError, read_rig
from tcbi_sim.rigs import load_rig

ROBOT = mjcf(trunk=1.15, friction=0.8, gain=10.0, weak=0.5)


@pytest.fixture(autouse=True)
def described(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder with model and description."""
    monkeypatch.setenv("TCBI_RIGS", str(tmp_path))
    (tmp_path / "quadruped.xml").write_text(mjcf())
    (tmp_path / "quadruped.toml").write_text(DESCRIPTION)
    (tmp_path / "log.toml").write_text(MAPPING)
    return tmp_path


def recorded(folder: Path, seconds: float = 2.0, names: tuple[str, ...] = (), again: int = 2) -> list[Measurement]:
    """Logs of the robot with the weak leg, read back."""
    mapping, found = load_mapping(folder / "log.toml"), []
    for n, (name, targets) in enumerate(motions(seconds).items()):
        for k in range(again if not names or name in names else 0):
            path = folder / f"{name}-{k}.csv"
            write_log(path, ROBOT, targets, 10 * n + k, yaw=0.5 * k)
            found.append(read_log(mapping, path))
    return found


def test_the_description_gives_a_robot_on_the_ground():
    rig = load_rig("quadruped")
    assert (rig.floating, rig.has_imu, rig.base) == (True, True, "trunk")
    assert rig.foot_names == tuple(LEGS) and rig.legs["rl"] == ("rl_hip", "rl_knee")
    assert rig.stand_height == pytest.approx(0.214)
    floors = [g.name for g in rig.build(0).worldbody.geoms]
    assert "floor" not in floors  # the model's own: scenarios tilt the one that is put in its place


def test_errors_are_looked_for_leg_by_leg_and_a_foot_without_a_leg_of_its_name_is_refused(described):
    rig = load_rig("quadruped")
    cells = joint_cells(rig)
    assert cells["rl leg"] == tuple(rig.index(j) for j in rig.legs["rl"]) and "rl_hip" in cells
    (described / "quadruped.toml").write_text(DESCRIPTION.replace('rl = ["rl_hip"', 'rear = ["rl_hip"'))
    with pytest.raises(RigFileError, match="legs: no leg has the name of foot rl; a leg has its foot's"):
        load_rig("quadruped")


def test_it_moves_about_its_posture_and_stays_on_its_feet(described):
    lines = "".join(f"{joint} = {angle}\n" for joint, angle in zip(JOINTS, POSTURE, strict=True))
    (described / "quadruped.toml").write_text(DESCRIPTION.replace("[ground]", f"[posture]\n{lines}[ground]"))
    rig = load_rig("quadruped")
    assert rig.stand_height == pytest.approx(0.2 * np.cos(0.6) + 0.014)
    motions = standard_motions(rig, 2.0)
    out = simulate(
        base_model(rig.name),
        np.array([[1.0, 12.0, 0.7]]),
        [m.scenario for m in motions],
        commands=[m.commands for m in motions],
    )
    assert np.abs(out.joint_position[0, :, 0] - POSTURE).max() < 0.1
    lean = np.abs(roll_pitch_yaw(out.attitude[0])[..., :2]).max()
    assert 0.01 < lean < 0.4 and not out.diverged.any()


def test_it_stands_and_leans_with_the_ground():
    model = base_model("quadruped")
    scenarios = [Scenario("stand", 1.0, pitch, 0.0, initial_joint_position=tuple(POSTURE)) for pitch in (0.0, 0.1)]
    commands = [Commands(np.zeros(1), POSTURE[None], 0.0)] * 2
    out = simulate(model, model.mean()[None], scenarios, commands=commands)
    assert out.contact is not None and out.contact[0, :, -1].all()
    tilt = np.abs(roll_pitch_yaw(out.attitude[0, :, -1])).max(axis=-1)
    assert tilt[0] < 0.02 and tilt[1] == pytest.approx(0.1, abs=0.02)


def test_a_log_has_the_signals_of_the_body(described):
    first, second = recorded(described, 1.0, ("pitch",))
    assert first.joint_names == JOINTS and first.foot_names == tuple(LEGS)
    assert first.contact is not None and first.contact.mean() > 0.9
    assert np.median(first.linear_acceleration[:, 2]) == pytest.approx(9.81, abs=0.3)
    assert np.degrees(np.abs(first.angular_velocity).max()) > 5.0
    for m in (first, second):  # the second headed elsewhere, and is the same motion all the same
        assert roll_pitch_yaw(m.attitude[0])[2] == pytest.approx(0.0, abs=1e-9)
    assert repeats([first, second]) == [[0, 1]] and guard([first, second]) == []


def test_a_command_that_is_held_is_no_gap(described):
    (held,) = recorded(described, 2.5, ("steps",), again=1)
    assert not any("No commands" in told for told in guard([held]))
    assert np.isfinite(compare(base_model("quadruped"), [held], particles=0).replay.measured[..., 0]).mean() > 0.95


def test_the_weak_leg_that_the_model_does_not_have_is_named(described):
    """Simulated by plain MuJoCo at steps of half a millisecond: not by the code under test."""
    model, seen = base_model("quadruped"), recorded(described, names=("squat", "pitch", "drawn", "steps", "sway"))
    found = diagnose(model, seen, uses=["weak_leg:fl", "weak_leg:rl", "backlash"], settings=QUICK)
    assert (found.verdict, found.uses) == (EFFECT, ("weak_leg:rl",))
    (share,) = found.ranking[0].parameters
    assert share.value == pytest.approx(0.5, abs=0.1)
    new = recorded(described, names=("roll", "twist"))
    before, after = (
        compare(m, new, particles=0).error_over_floor for m in (model, adopt(model, "weak_leg:rl", found.to_json()))
    )
    assert after < 0.6 * before


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('imu = "imu"', 'imu = "head"', "ground.imu: got 'head', allowed is a site of the model: imu"),
        ("sliding_friction = 0.7\n[feet]", "sliding_friction = -1\n[feet]", "ground.sliding_friction: got -1"),
        ('fl = "fl_foot"', 'fl = "floor"', "feet: got .*sphere of the model for each foot, out of fl_foot"),
        ("[ground]", "[floor]", "give \\[ground\\] and \\[feet\\]"),
        ('"fl_knee"]', '"fl_ankle"]', "legs: got .*allowed are lists of the joints"),
    ],
)
def test_what_is_wrong_with_a_description_is_told(described, old, new, told):
    (described / "quadruped.toml").write_text(DESCRIPTION.replace(old, new, 1))
    with pytest.raises(RigFileError, match=told):
        read_rig(described / "quadruped.toml")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"xyzw"', '"zyxw"', "attitude.order: got 'zyxw', allowed is wxyz or xyzw"),
        ('unit = "deg/s"', 'unit = "rpm"', "angular_velocity.unit: got 'rpm', allowed is one of rad/s, deg/s"),
        ('columns = ["ax", "ay", "az"]', 'columns = ["ax"]', "linear_acceleration.columns: .* a list of 3 names"),
        ("threshold = 1.0", "threshold = 0", "contact.threshold: got 0, allowed is a number above 0"),
        ("threshold = 1.0", 'feet = ["left"]', "contact.feet: got .*the feet of the rig: fl, fr, rl, rr"),
        ('source = "robot"', "window = 2.0", "window: a robot that stands free begins at rest"),
        ("[contact]", '[roll_pitch_yaw]\ncolumns = ["x", "y", "z"]\n[contact]', "attitude and roll_pitch_yaw: both"),
    ],
)
def test_what_is_wrong_with_a_mapping_of_the_body_is_told(described, old, new, told):
    (described / "log.toml").write_text(MAPPING.replace(old, new, 1))
    with pytest.raises(MappingError, match=told):
        load_mapping(described / "log.toml")


def test_orientations_of_zeros_are_told(described):
    path = described / "squat.csv"
    write_log(path, ROBOT, motions(0.5)["squat"], 0)
    lines = path.read_text().splitlines()
    column = lines[0].split(",").index("x")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[column : column + 4] = ["0"] * 4
    path.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]))
    with pytest.raises(MappingError, match=rf"{RATE // 2} orientations that are no quaternions"):
        read_log(load_mapping(described / "log.toml"), path)
