"""Bags that another program wrote, or that went wrong: used as far as they go, with one clear line each."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_cases import bench, rollout
from rosbags.rosbag2 import StoragePlugin, Writer

from tcbi_contract.names import FOOT_CONTACTS, IMU, JOINT_COMMANDS, JOINT_STATES, JOINTS, ROLLOUT_EVENT, TRACKER_POSE
from tcbi_infer.bags import encoding, schemas
from tcbi_infer.bags.encoding import messages
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_bag, read_measurement, read_measurements
from tcbi_infer.bags.tracker import heading, wanted_heading
from tcbi_infer.bags.writer import BagWriter
from tcbi_infer.compare.errors import WrongJointsError
from tcbi_infer.compare.replay import Replay
from tcbi_infer.errors import BagError
from tcbi_sim.measurement import Commands, Measurement, Scenario, progress, quaternion_from_rpy
from tcbi_sim.model import base_model
from tcbi_sim.sensing import multiply

START = 5_000_000_000
Row = tuple[str, int, bytes]


def written(folder: Path, rows: list[Row], name: str = "lab", root: str = "/") -> Path:
    with BagWriter(folder, name) as bag:
        for topic, time, data in rows:
            bag.write(root + topic, time, data)
    return bag.path


def rows(case=None, keep: Callable[[Row], bool] = lambda row: True) -> list[Row]:
    return [row for row in messages(case or rollout(), START) if keep(row)]


def without(*topics: str) -> Callable[[Row], bool]:
    return lambda row: row[0] not in topics


def joint_rows(stamps: list[float], joint_names=JOINTS, value=lambda i: float(i)) -> list[Row]:
    found = []
    for i, t in enumerate(stamps):
        stamp = START + round(t * 1e9)
        message = encoding.joint_state(stamp, joint_names, np.full(len(joint_names), value(i)))
        found.append((JOINT_STATES, stamp, schemas.encode(message, schemas.MESSAGES[JOINT_STATES])))
    return found


def only_note(measurement, words: str) -> str:
    found = [note for note in measurement.notes if words in note]
    assert len(found) == 1, measurement.notes
    assert "\n" not in found[0]
    return found[0]


@pytest.mark.parametrize(
    ("topic", "field", "cost"),
    [
        (IMU, "attitude", "attitude and body rates cannot be compared"),
        (FOOT_CONTACTS, "contact", "contacts cannot be compared"),
        (TRACKER_POSE, "position", "path cannot be compared"),
    ],
)
def test_a_missing_topic_is_absent_and_its_cost_is_said(tmp_path, topic, field, cost):
    back = read_measurement(written(tmp_path, rows(keep=without(topic))))
    assert getattr(back, field) is None
    only_note(back, cost)
    assert np.array_equal(back.joint_position, rollout().joint_position)


def test_without_commands_the_rest_is_still_there(tmp_path):
    back = read_measurement(written(tmp_path, rows(keep=without(JOINT_COMMANDS))))
    assert back.commands.target.shape == (0, 18)
    only_note(back, "no joint_commands")


def test_without_events_time_starts_at_the_first_sample(tmp_path):
    back = read_measurement(written(tmp_path, rows(keep=without(ROLLOUT_EVENT))))
    assert back.time[0] == 0 and back.rollout_id == "lab" and back.scenario.task == "unknown"
    assert back.scenario.duration == pytest.approx(2.0)
    only_note(back, "no rollout/event")


@pytest.mark.parametrize("rate", [10.0, 187.0, 500.0])
def test_any_rate_of_joint_states_is_its_own_time_axis(tmp_path, rate):
    case = rollout(samples=round(2 * rate) + 1, rate=rate)
    back = read_measurement(written(tmp_path, rows(case)))
    assert len(back.time) == len(case.time)
    np.testing.assert_allclose(back.time, case.time, atol=1e-9)
    assert back.notes == ()


def test_signals_of_other_rates_are_put_on_the_joints_time(tmp_path):
    fast = rollout(samples=401, rate=200.0)
    times = {t for _, t, _ in rows(fast, lambda row: row[0] == IMU)}
    every_other = set(sorted(times)[::2])
    back = read_measurement(written(tmp_path, rows(fast, lambda row: row[0] != IMU or row[1] in every_other)))
    assert np.array_equal(back.angular_velocity[::2], fast.angular_velocity[::2])
    np.testing.assert_allclose(
        back.angular_velocity[1:-1:2], (fast.angular_velocity[0:-2:2] + fast.angular_velocity[2::2]) / 2, atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.norm(back.attitude, axis=1), 1.0)


def test_joints_in_another_order_are_put_in_the_rigs_by_name(tmp_path):
    case = rollout()
    order = np.random.default_rng(1).permutation(18)
    changed = []
    for topic, time, data in rows(case):
        if topic == JOINT_STATES:
            message = schemas.typestore().deserialize_cdr(data, schemas.MESSAGES[topic])
            shuffled = encoding.joint_state(
                time, [JOINTS[i] for i in order] + ["gripper"], [*message.position[order], 9.0]
            )
            data = schemas.encode(shuffled, schemas.MESSAGES[topic])
        changed.append((topic, time, data))
    back = read_measurement(written(tmp_path, changed))
    assert back.joint_names == JOINTS and np.array_equal(back.joint_position, case.joint_position)
    assert "gripper left out" in only_note(back, "another order")


def pendulum(joint_names: tuple[str, ...], rig: str = "double_pendulum") -> Measurement:
    """A rollout whose every value is the place of its joint's name in the alphabet."""
    place = [float(ord(name[0]) - ord("a")) for name in joint_names]
    begin = {"initial_joint_position": tuple(place), "initial_joint_velocity": tuple(-x for x in place)}
    commands = Commands(np.array([0.0]), np.array([place]), 0.0)
    time = np.arange(20) * 0.01
    values = np.tile(place, (20, 1))
    return Measurement(
        "log", rig, Scenario("log", float(time[-1]), **begin), "", "log", commands, joint_names, (), time, values
    )


@pytest.mark.parametrize(
    "joint_names", [("shoulder", "elbow"), ("elbow", "shoulder"), ("gripper", "elbow", "shoulder")]
)
def test_joints_of_any_known_rig_are_read_in_its_order(tmp_path, joint_names):
    m = read_measurement(write_measurement(tmp_path, pendulum(joint_names)))
    assert m.joint_names == ("shoulder", "elbow")
    assert m.joint_position[0].tolist() == m.commands.target[0].tolist() == [18.0, 4.0]
    assert (m.scenario.initial_joint_position, m.scenario.initial_joint_velocity) == ((18.0, 4.0), (-18.0, -4.0))
    assert bool(m.notes) == (joint_names != m.joint_names)


def test_a_recording_without_a_joint_of_its_rig_is_compared_with_nothing(tmp_path):
    m = read_measurement(write_measurement(tmp_path, pendulum(("shoulder", "wrist"))))
    assert m.joint_names == ("shoulder", "wrist")
    with pytest.raises(WrongJointsError, match="joints shoulder, elbow, but a rollout of it has shoulder, wrist"):
        Replay.of(base_model("double_pendulum"), [m])


def test_a_bag_of_a_rig_whose_file_is_broken_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("TCBI_RIGS", str(tmp_path))
    (tmp_path / "arm.toml").write_text("model = 3\n")
    bag = write_measurement(tmp_path, pendulum(("shoulder",), "arm"))
    with pytest.raises(BagError, match=r"its rig cannot be used: rig file .*arm\.toml"):
        read_measurement(bag)


def test_lost_messages_leave_a_gap_that_is_named(tmp_path):
    case = rollout(samples=201)
    gap = (START + 1_000_000_000, START + 1_600_000_000)
    back = read_measurement(written(tmp_path, rows(case, lambda row: not gap[0] < row[1] < gap[1])))
    note = only_note(back, "joint_states: 1 gap")
    assert "0.60 s at 1.00 s" in note
    assert len(back.time) == 201 - 29


def test_a_gap_in_one_topic_is_kept_with_the_fields_that_it_interrupts(tmp_path):
    case = rollout(samples=201)
    gap = (START + 1_000_000_000, START + 1_600_000_000)
    back = read_measurement(written(tmp_path, rows(case, lambda row: row[0] != IMU or not gap[0] < row[1] < gap[1])))
    assert [name for name, *_ in back.gaps] == ["attitude", "angular_velocity", "linear_acceleration"]
    assert back.gaps[0][1:] == (pytest.approx(1.0), pytest.approx(1.6))
    only_note(back, "imu/data: 1 gap")


def test_a_topic_that_starts_late_and_stops_early_is_not_measured_there(tmp_path):
    case = rollout(samples=201)
    first, last = START + 600_000_000, START + 3_000_000_000
    back = read_measurement(written(tmp_path, rows(case, lambda row: row[0] != IMU or first <= row[1] <= last)))
    assert [gap for gap in back.gaps if gap[0] == "attitude"] == [
        ("attitude", 0.0, pytest.approx(0.6)), ("attitude", pytest.approx(3.0), pytest.approx(4.0))
    ]  # fmt: skip
    assert {name for name, *_ in back.gaps} == {"attitude", "angular_velocity", "linear_acceleration"}
    assert only_note(back, "imu/data") == (
        "imu/data: 2 gaps, 1.60 s in all, the longest 1.00 s at 3.00 s; nothing is compared inside"
    )


def test_a_few_lost_messages_are_no_gap(tmp_path):
    case = rollout(samples=201)
    lost = {START + round(k * 0.02 * 1e9) for k in (20, 80, 81, 150)}
    back = read_measurement(written(tmp_path, rows(case, lambda row: row[0] != JOINT_STATES or row[1] not in lost)))
    assert len(back.time) == 197 and back.notes == ()


def test_messages_that_overtook_each_other_are_sorted(tmp_path):
    stamps = [k * 0.02 for k in range(100)]
    stamps[40], stamps[41] = stamps[41], stamps[40]
    back = read_measurement(written(tmp_path, joint_rows(stamps)))
    assert np.all(np.diff(back.time) > 0) and len(back.time) == 100
    assert back.joint_position[40, 0] == 41.0
    only_note(back, "1 sample arrived out of order")


def test_repeated_stamps_count_once(tmp_path):
    stamps = [(k // 2) * 0.02 for k in range(100)]
    back = read_measurement(written(tmp_path, joint_rows(stamps)))
    assert len(back.time) == 50 and back.joint_position[3, 0] == 6.0
    only_note(back, "50 samples with the stamp of another")


def test_without_stamps_the_recording_time_is_used(tmp_path):
    found = []
    for k in range(50):
        message = encoding.joint_state(0, JOINTS, np.full(18, float(k)))
        found.append((JOINT_STATES, START + k * 20_000_000, schemas.encode(message, schemas.MESSAGES[JOINT_STATES])))
    back = read_measurement(written(tmp_path, found))
    np.testing.assert_allclose(back.time, np.arange(50) * 0.02)
    only_note(back, "50 of 50 messages bear no stamp")


def test_another_robot_is_refused_by_its_joints(tmp_path):
    bag = written(tmp_path, joint_rows([0.0, 0.1, 0.2], ("shoulder", "elbow")))
    with pytest.raises(BagError, match=r"another robot: its joints are shoulder, elbow.*\./tcbi import"):
        read_measurement(bag)
    assert read_measurement(bag, rig="arm").joint_names == ("shoulder", "elbow")


def test_joints_count_more_than_a_note_that_calls_the_robot_a_hexapod(tmp_path):
    begin = rows(keep=lambda row: row[0] == ROLLOUT_EVENT)
    bag = written(tmp_path, begin + joint_rows([0.0, 0.1, 0.2], ("shoulder", "elbow")))
    with pytest.raises(BagError, match="another robot: its joints are shoulder, elbow"):
        read_measurement(bag)


def test_a_rollout_of_another_rig_is_refused_by_name(tmp_path):
    bag = write_measurement(tmp_path, bench())
    assert read_measurement(bag, rig="servo_bench").scenario.constant("kp") == 100.0
    with pytest.raises(BagError, match="of the rig 'servo_bench', wanted is 'hexapod'"):
        read_measurement(bag, rig="hexapod")


def test_an_empty_bag_says_so(tmp_path):
    with pytest.raises(BagError, match="the bag is empty"):
        read_measurement(written(tmp_path, []))


def test_an_empty_file_says_so(tmp_path):
    path = tmp_path / "x.mcap"
    path.touch()
    with pytest.raises(BagError, match=r"the bag is empty.*x\.mcap: the file has no bytes"):
        read_measurement(path)


def test_a_bag_without_joint_states_says_what_it_has(tmp_path):
    bag = written(tmp_path, rows(keep=lambda row: row[0] == IMU))
    with pytest.raises(BagError, match=r"no joint_states .* it has /imu/data; record it while"):
        read_measurement(bag)


@pytest.mark.parametrize("name", ["nowhere", "notes.txt", "empty"])
def test_what_is_no_bag_is_said_in_one_line(tmp_path, name):
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError) as error:
        read_measurement(tmp_path / name)
    assert name in str(error.value) and "\n" not in str(error.value)


def test_an_sqlite_bag_comes_with_the_command_that_converts_it(tmp_path):
    with Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3):
        pass
    with pytest.raises(BagError, match=r"rosbags-convert --src .*old .*--dst-storage mcap"):
        read_measurement(tmp_path / "old")


def test_two_robots_in_one_bag_need_a_choice(tmp_path):
    with BagWriter(tmp_path, "two") as bag:
        for robot in ("a", "b"):
            for topic, time, data in rows():
                bag.write(f"/{robot}/{topic}", time, data)
    with pytest.raises(BagError, match=r"2 robots .* --namespace"):
        read_measurement(bag.path)
    assert len(read_bag(bag.path, namespace="/b")) == 1
    with pytest.raises(BagError, match="no joint_states under the namespace 'c'"):
        read_bag(bag.path, namespace="c")


def test_a_bag_of_a_whole_session_gives_each_rollout(tmp_path):
    first, second = rollout("one"), rollout("two", seed=1)
    with BagWriter(tmp_path, "session") as bag:
        for topic, time, data in messages(first, START):
            bag.write("/" + topic, time, data)
        for topic, time, data in messages(second, START + 10_000_000_000):
            bag.write("/" + topic, time, data)
    found = read_bag(bag.path)
    assert [m.rollout_id for m in found] == ["one", "two"]
    assert np.array_equal(found[1].joint_position, second.joint_position)
    with pytest.raises(BagError, match="holds 2 rollouts"):
        read_measurement(bag.path)


def test_a_bag_of_the_rosbags_library_reads_alike(tmp_path):
    case = rollout()
    store = schemas.typestore()
    with Writer(tmp_path / "other", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, time, data in rows(case):
            if topic not in connections:
                connections[topic] = writer.add_connection("/ns/" + topic, schemas.MESSAGES[topic], typestore=store)
            writer.write(connections[topic], time, data)
    back = read_measurement(tmp_path / "other")
    assert back.rollout_id == "walk_1" and np.array_equal(back.joint_position, case.joint_position)
    assert np.array_equal(back.contact, case.contact)


def test_a_note_that_is_plain_text_is_kept_out_of_the_numbers(tmp_path):
    changed = []
    for topic, time, data in rows():
        if topic == ROLLOUT_EVENT:
            message = store_message(data)
            message.note = "battery changed before this one"
            data = schemas.encode(message, schemas.MESSAGES[topic])
        changed.append((topic, time, data))
    back = read_measurement(written(tmp_path, changed))
    assert back.rig == "hexapod" and back.scenario.duration == pytest.approx(2.0)
    assert back.scenario.slope_roll == rollout().scenario.slope_roll


def store_message(data: bytes):
    return schemas.typestore().deserialize_cdr(data, schemas.MESSAGES[ROLLOUT_EVENT])


def test_a_rollout_that_ended_before_anything_was_measured_is_left_out_beside_others(tmp_path):
    empty = written(tmp_path, rows(keep=lambda row: row[0] == ROLLOUT_EVENT), "empty")
    good = written(tmp_path, rows(), "good")
    told: list[str] = []
    assert [m.rollout_id for m in read_measurements([tmp_path], left_out=told.append)] == [rollout().rollout_id]
    assert len(told) == 1 and str(empty) in told[0]
    for paths, listener in (([empty], told.append), ([empty, good], None)):
        with pytest.raises(BagError, match="no joint_states"):
            read_measurements(paths, left_out=listener)


def test_a_policy_that_was_changed_meanwhile_is_named_as_both(tmp_path):
    found = []
    for topic, time, data in rows():
        if topic == ROLLOUT_EVENT:
            event = schemas.typestore().deserialize_cdr(data, schemas.MESSAGES[ROLLOUT_EVENT])
            if event.kind == encoding.END:
                event.policy_id = "balance-1@2"
            data = schemas.encode(event, schemas.MESSAGES[ROLLOUT_EVENT])
        found.append((topic, time, data))
    back = read_measurement(written(tmp_path, found))
    assert back.policy_id == f"{rollout().policy_id} then balance-1@2"
    only_note(back, "the policy was changed meanwhile")


@pytest.mark.parametrize("angle", [np.pi / 2, -2.5, 0.03])
def test_a_tracker_whose_frame_is_turned_against_the_robots_heading(tmp_path, angle):
    case = rollout()
    seen = wanted_heading(case.scenario) + angle
    w, z = np.cos(seen / 2), np.sin(seen / 2)
    cos, sin = np.cos(angle), np.sin(angle)
    frame = case.position @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + [3.0, -1.0, 0.0]
    poses = []
    for i, t in enumerate(case.time):
        stamp = START + round(t * 1e9)
        message = encoding.tracker_pose(stamp, frame[i])
        o = message.pose.orientation
        o.x, o.y, o.z, o.w = 0.0, 0.0, z, w
        poses.append((TRACKER_POSE, stamp, schemas.encode(message, schemas.MESSAGES[TRACKER_POSE])))
    found = read_measurement(written(tmp_path, [*rows(case, without(TRACKER_POSE)), *poses]))
    away = progress(case.position, case.scenario.initial_yaw)
    if abs(angle) < 0.05:
        np.testing.assert_allclose(found.position, frame, atol=1e-9)
        assert not [note for note in found.notes if "turned" in note]
    else:
        only_note(found, f"positions are turned by {-np.degrees(angle):.0f} degrees")
        np.testing.assert_allclose(progress(found.position, case.scenario.initial_yaw), away, atol=1e-9)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.4, -0.3, 0.0), (0.5, 0.4, 1.2), (-0.2, 0.5, -2.8)])
def test_where_a_robot_heads_on_its_slope(roll, pitch, yaw):
    slope, turn = (quaternion_from_rpy(*np.array(angles)) for angles in ((roll, pitch, 0.0), (0.0, 0.0, yaw)))
    w, x, y, z = multiply(slope, turn)
    scenario = Scenario("balance", 1.0, slope_roll=roll, slope_pitch=pitch, initial_yaw=yaw)
    assert wanted_heading(scenario) == pytest.approx(heading((x, y, z, w)))
