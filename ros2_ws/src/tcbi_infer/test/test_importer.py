"""Logs of other formats become rollouts, exactly where the numbers are exact, and what is wrong is said in one line."""

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from bag_cases import differences

from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.errors import MappingError
from tcbi_infer.importer import logs_in, read_log
from tcbi_infer.mapping import built_in, load_mapping
from tcbi_sim.errors import UnknownNameError

DATA = Path(os.environ.get("TCBI_DATA", Path(__file__).parents[5] / "shared" / "data"))
real_data = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason="no real recordings (TCBI_DATA or ../shared/data)"),
]

SAMPLES = [
    {"timestamp": 0.010, "position": 0.1, "goal_position": 0.0, "torque_enable": True},
    {"timestamp": 0.015, "position": 0.2, "goal_position": 0.5, "torque_enable": True},
    {"timestamp": 0.021, "position": 0.3, "goal_position": 0.5, "torque_enable": True},
    {"timestamp": 0.030, "position": 0.4, "goal_position": 0.5, "torque_enable": False},
    {"timestamp": 0.035, "position": 0.5, "goal_position": 0.6, "torque_enable": False},  # too late to move anything
]
HEADER = {"kp": 100, "mass": 0.49, "length": 0.1, "vin": 7.4}


def log(folder: Path, samples=SAMPLES, name="kp100_sin.json", **header) -> Path:
    path = folder / name
    path.write_text(json.dumps({**HEADER, **header, "entries": samples}))
    return path


def mapping_file(folder: Path, text: str) -> Path:
    path = folder / "mapping.toml"
    path.write_text(text)
    return path


def test_a_json_log_becomes_a_rollout_of_its_rig(tmp_path):
    m = read_log(load_mapping("xl330_bench"), log(tmp_path))
    assert (m.rollout_id, m.rig, m.joint_names) == ("kp100_sin", "motor_bench", ("servo",))
    np.testing.assert_array_equal(m.time, [0.0, 0.005, 0.011, 0.02, 0.025])
    np.testing.assert_array_equal(m.joint_position[:, 0], [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_array_equal(m.commands.time, [0.0, 0.005, 0.02])
    np.testing.assert_array_equal(m.commands.target[:, 0], [0.0, 0.5, 0.5])
    np.testing.assert_array_equal(m.commands.torque_on, [True, True, False])
    assert m.commands.ramp == 0.0 and m.notes == ()
    assert m.scenario.constant("kp") == 100 and m.scenario.initial_joint_position == (0.1,)


def test_the_joints_have_the_names_of_the_built_in_rig():
    from tcbi_sim.rigs import load_rig

    mapping = load_mapping("xl330_bench")
    assert mapping.joints == load_rig(mapping.rig).joint_names


def test_an_imported_rollout_survives_its_bag(tmp_path):
    m = read_log(load_mapping("xl330_bench"), log(tmp_path))
    assert differences(m, read_measurement(write_measurement(tmp_path / "bags", m))) == []


@pytest.mark.parametrize("no_goal", [None, float("nan"), ""])
def test_a_limp_servo_that_is_given_no_goal_keeps_its_torque_flag(tmp_path, no_goal):
    samples = [{**s, "goal_position": s["goal_position"] if s["torque_enable"] else no_goal} for s in SAMPLES]
    m = read_log(load_mapping("xl330_bench"), log(tmp_path, samples))
    np.testing.assert_array_equal(m.commands.time, [0.0, 0.005, 0.02])
    np.testing.assert_array_equal(m.commands.target[:, 0], [0.0, 0.5, 0.5])
    np.testing.assert_array_equal(m.commands.torque_on, [True, True, False])
    assert m.notes == ()
    assert differences(m, read_measurement(write_measurement(tmp_path / "bags", m))) == []


def test_a_servo_that_is_limp_before_its_first_goal_has_the_first_position_as_its_goal(tmp_path):
    goals = [(None, False), (None, False), (0.5, True), (None, False), (0.7, True)]
    samples = [{**s, "goal_position": g, "torque_enable": on} for s, (g, on) in zip(SAMPLES, goals, strict=True)]
    m = read_log(load_mapping("xl330_bench"), log(tmp_path, [samples[i] for i in (0, 1, 3, 2, 4)]))
    np.testing.assert_array_equal(m.commands.time, [0.0, 0.011, 0.02])
    np.testing.assert_array_equal(m.commands.target[:, 0], [0.1, 0.5, 0.5])  # in the order of time, not of the file
    np.testing.assert_array_equal(m.commands.torque_on, [False, True, False])


def test_a_log_that_begins_limp_may_hold_no_goal_at_all_by_then(tmp_path):
    limp = {k: v for k, v in SAMPLES[0].items() if k != "goal_position"} | {"torque_enable": False}
    m = read_log(load_mapping("xl330_bench"), log(tmp_path, [limp, *SAMPLES[1:]]))
    assert m.commands.torque_on is not None and not m.commands.torque_on[0]


@pytest.mark.parametrize("missing", ["", "null", "[]"])
def test_a_limp_arm_may_hold_an_empty_list_of_goals(tmp_path, missing):
    text = CSV_MAPPING.replace('columns = ["ta", "tb"]', 'column = "u"\nlist = true') + '[torque_on]\ncolumn = "on"\n'
    path = tmp_path / "run.csv"
    rows = ["t,qa,qb,u,on", '0,0,0,"[1,2]",1', f"10,0,0,{missing},0", '20,0,0,"[3,4]",1', "30,0,0,[],0"]
    path.write_text("\n".join(rows) + "\n")
    m = read_log(load_mapping(mapping_file(tmp_path, text)), path)
    np.testing.assert_array_equal(m.commands.torque_on, [True, False, True])
    path.write_text("\n".join(rows).replace(f",{missing},", ",0,") + "\n")
    with pytest.raises(MappingError, match="sample 2 of 'u' is no list of numbers"):
        read_log(load_mapping(mapping_file(tmp_path, text)), path)


@pytest.mark.parametrize("flag", [True, None])
def test_a_command_without_a_number_is_left_out_and_told_where_its_servo_is_not_limp(tmp_path, flag):
    samples = [dict(s, torque_enable=True) for s in SAMPLES]
    for sample in samples[2:4]:
        sample.update(goal_position=None, torque_enable=flag)
    m = read_log(load_mapping("xl330_bench"), log(tmp_path, samples))
    np.testing.assert_array_equal(m.commands.time, [0.0, 0.005])
    assert m.commands.torque_on is None
    assert m.notes == ("goal_position: left out 2 commands without a number",)


def test_a_limp_motor_that_is_given_no_torque_has_none(tmp_path):
    text = CSV_MAPPING + '[torque_on]\ncolumn = "on"\n'
    path = tmp_path / "run.csv"
    path.write_text("t,qa,qb,ta,tb,on\n0,90,180,,,0\n10,0,0,1,3,1\n20,0,0,nan,,0\n30,0,0,,,0\n")
    m = read_log(load_mapping(mapping_file(tmp_path, text)), path)
    np.testing.assert_array_equal(m.commands.target, [[0, 0], [1, 3], [0, 0]])
    np.testing.assert_array_equal(m.commands.torque_on, [False, True, False])


def test_repeated_and_backward_times_are_put_in_order_and_said(tmp_path):
    times = [0.0, 0.02, 0.01, 0.03, 0.03, 0.04]
    samples = [{**SAMPLES[0], "timestamp": t, "position": t} for t in times]
    m = read_log(load_mapping("xl330_bench"), log(tmp_path, samples))
    np.testing.assert_array_equal(m.time, [0.0, 0.01, 0.02, 0.03, 0.04])
    np.testing.assert_array_equal(m.joint_position[:, 0], [0.0, 0.01, 0.02, 0.03, 0.04])
    text = " ".join(m.notes)
    assert "out of order" in text and "with the stamp of another" in text


CSV_MAPPING = """
rig = "double_pendulum"
joints = ["shoulder", "elbow"]
[time]
column = "t"
unit = "ms"
[position]
columns = ["qa", "qb"]
unit = "deg"
scale = [1, -1]
offset = [0.0, -90]
[command]
columns = ["ta", "tb"]
kind = "torque"
unit = "N m"
[constants]
link = 0.3
"""


def test_joints_in_another_order_than_the_rigs_and_one_more_are_taken(tmp_path):
    text = CSV_MAPPING.replace('"shoulder", "elbow"', '"elbow", "shoulder", "jaw"').replace('"qb"]', '"qb", "ta"]')
    text = text.replace("[1, -1]", "[1, -1, 1]").replace("[0.0, -90]", "[0, -90, 0]").replace('"tb"]', '"tb", "ta"]')
    path = tmp_path / "run.csv"
    path.write_text("t,qa,qb,ta,tb\n0,90,180,1,2\n10,0,0,1,3\n")
    m = read_log(load_mapping(mapping_file(tmp_path, text)), path)
    back = read_measurement(write_measurement(tmp_path / "bags", m, torque_commands=True))
    assert back.joint_names == ("shoulder", "elbow") and back.commands.target[0].tolist() == [2, 1]
    np.testing.assert_allclose(back.joint_position[0], [-1.5 * np.pi, np.pi / 2])
    np.testing.assert_allclose(back.scenario.initial_joint_position, [-1.5 * np.pi, np.pi / 2])


@pytest.mark.parametrize("packed", [False, True])
def test_a_csv_log_with_units_signs_and_offsets(tmp_path, packed):
    text = "t,qa,qb,ta,tb\n0,90,180,1,2\n10,0,0,1,3\n20,45,90,1,3\n25,4"
    path = tmp_path / ("run.csv.gz" if packed else "run.csv")
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    mapping = load_mapping(mapping_file(tmp_path, CSV_MAPPING))
    m = read_log(mapping, path)
    assert m.rollout_id == "run" and mapping.torque_commands
    np.testing.assert_allclose(m.joint_position[0], [np.pi / 2, -1.5 * np.pi])
    np.testing.assert_array_equal(m.time, [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(m.commands.target, [[1, 2], [1, 3]])
    assert m.scenario.constant("link") == 0.3
    bag = write_measurement(tmp_path / "bags", m, torque_commands=True)
    assert differences(m, read_measurement(bag)) == []


def test_rows_of_another_width_are_told_but_a_cut_off_last_line_is_not(tmp_path):
    path = tmp_path / "run.csv"
    whole = "t,qa,qb,ta,tb\n0,90,180,1,2\n\n5,45\n10,0,0,1,3\n15,1,2,3,4,5\n20,45,90,1,3\n"
    mapping = load_mapping(mapping_file(tmp_path, CSV_MAPPING))
    for text in (whole, whole + "25,4", whole + "\n\n"):
        path.write_text(text)
        m = read_log(mapping, path)
        np.testing.assert_array_equal(m.time, [0.0, 0.01, 0.02])
        assert m.notes == ("run.csv: left out 2 rows of another width than the header's 5, the first in line 4",)


def test_rows_of_another_width_are_told_of_every_file(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "states.csv").write_text("t,qa,qb\n0,90,180\n10,0,0\n")
    (folder / "commands.csv").write_text("t,ta,tb\n0,1,2\n1,2\n5,2,3\n")
    (folder / "slow.csv").write_text("t,volt\n0,7.4\n1\n5,7.3\n")
    text = CSV_MAPPING.replace("[command]", '[command]\nfile = "commands.csv"').replace(
        "[position]", '[position]\nfile = "states.csv"'
    )
    text += '[readings]\nvoltage_V = {column = "volt", file = "slow.csv"}\n'
    m = read_log(load_mapping(mapping_file(tmp_path, text)), folder)
    assert [note.partition(" of another")[0] for note in m.notes] == [
        "commands.csv: left out 1 row",
        "slow.csv: left out 1 row",
    ]


def test_a_log_whose_rows_all_have_another_width_than_its_header_says_so(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,qa,qb,ta,tb\n0,90,180,1,2,\n10,0,0,1,3,\n")
    with pytest.raises(MappingError, match=r"holds 0 samples.*left out 2 rows.*the header's 5, the first in line 2"):
        read_log(load_mapping(mapping_file(tmp_path, CSV_MAPPING)), path)


def test_list_columns_in_two_files_of_a_folder(tmp_path):
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "state_motor.csv").write_text(
        'type,timestamp,positions\nS,100.5,"[1, 2, 3, 4, 5, 6]"\nS,20100.5,"[2, 3, 4, 5, 6, 7]"\n'
    )
    (folder / "control.csv").write_text(
        'type,timestamp,positions\nC,50,"[0, 0, 0, 0, 0, 0]"\nC,10100.5,"[1, 1, 1, 1, 1, 1]"\n'
    )
    mapping = load_mapping("so101_arm")
    assert logs_in([tmp_path], mapping) == [folder]
    m = read_log(mapping, folder)
    assert m.rollout_id == "sweep" and m.joint_position.shape == (2, 6)
    np.testing.assert_array_equal(m.time, [0.0, 0.02])
    np.testing.assert_array_equal(m.commands.time, [0.0, 0.01])
    np.testing.assert_array_equal(m.commands.target[1], np.ones(6))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('rig = "x"\njoints = ["a"]\ncolour = 1\n[position]\ncolumn = "p"\n', "unknown key 'colour'"),
        ('joints = ["a"]\n[position]\ncolumn = "p"\n', "rig: got ''"),
        ('rig = "x"\njoints = ["a", "b"]\n[position]\ncolumn = "p"\n', "position.columns"),
        (
            'rig = "x"\njoints = ["a"]\n[time]\nunit = "h"\n[position]\ncolumn = "p"\nunit = "grad"\n',
            "time.unit.*position.unit",
        ),
        ('rig = "x"\njoints = ["a"]\n', r"\[position\] is missing"),
        ("rig = ", "is no TOML"),
        (
            'rig = "double_pendullum"\njoints = ["a"]\ncolour = 1\n[position]\ncolumn = "p"\n',
            "unknown key 'colour'; rig: unknown rig 'double_pendullum'; did you mean 'double_pendulum'",
        ),
        (
            'rig = "double_pendulum"\njoints = ["elbow", "wrist"]\n[position]\ncolumns = ["p", "q"]\n',
            "joints: got elbow, wrist; the rig 'double_pendulum' has shoulder, elbow, of which shoulder is missing",
        ),
    ],
)
def test_a_wrong_mapping_names_all_its_faults_in_one_line(tmp_path, text, words):
    with pytest.raises(MappingError, match=words) as error:
        load_mapping(mapping_file(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("pick = 3", "position.pick: got 3, allowed is a list"),
        ('pick = "a"', "position.pick: got 'a'"),
        ('pick = ["a"]', r"position.pick: got \['a'\]"),
        ("pick = [-1]", r"position.pick: got \[-1\]"),
        ("unit = []", r"position.unit: got \[\], allowed is one of rad"),
        ("unit = {}", "position.unit: got {}"),
        ('list = "no"', "position.list: got 'no', allowed is true or false"),
        ("file = 1", "position.file: got 1, allowed is a name"),
        ("time = []", r"position.time: got \[\]"),
        ("[time]\nunit = []\ncolumn = 1", "time.column: got 1.*time.unit: got "),
        ("[readings]\ntemperature_C = {column = 1}", "readings.temperature_C.column: got 1"),
    ],
)
def test_a_value_of_the_wrong_type_in_a_mapping_is_named(tmp_path, line, words):
    text = f'rig = "x"\njoints = ["a"]\n[position]\ncolumn = "p"\n{line}\n'
    with pytest.raises(MappingError, match=words) as error:
        load_mapping(mapping_file(tmp_path, text))
    assert "\n" not in str(error.value)


def test_an_unknown_mapping_lists_the_built_in_ones():
    with pytest.raises(UnknownNameError, match=r"did you mean 'xl330_bench'.*double_pendulum, so101_arm, xl330_bench"):
        load_mapping("xl331_bench")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "is no JSON .*; record or copy it again"),
        ("{}", "no list of samples under 'entries'"),
        (json.dumps({**HEADER, "entries": [{"timestamp": 0}]}), "no column 'position'"),
        (json.dumps({**HEADER, "entries": [{**SAMPLES[0], "position": "x"}]}), "no number"),
        (json.dumps({**HEADER, "entries": SAMPLES[:1]}), "1 samples .* at least 2"),
        (json.dumps({"kp": "high", "entries": SAMPLES}), "constant 'kp'.*constant 'mass'"),
    ],
)
def test_a_wrong_log_is_said_in_one_line(tmp_path, content, words):
    path = tmp_path / "bad.json"
    path.write_text(content)
    with pytest.raises(MappingError, match=words):
        read_log(load_mapping("xl330_bench"), path)


@pytest.mark.parametrize("rows", [[], ["20,3,3"], ["0,,", "5,,"]])
def test_a_log_without_a_command_in_its_time_is_a_rollout_without_commands(tmp_path, rows):
    text = CSV_MAPPING.replace("[command]", '[command]\nfile = "commands.csv"').replace(
        "[position]", '[position]\nfile = "states.csv"'
    )
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "states.csv").write_text("t,qa,qb\n0,90,180\n10,0,0\n")
    (folder / "commands.csv").write_text("\n".join(["t,ta,tb", *rows]))
    m = read_log(load_mapping(mapping_file(tmp_path, text)), folder)
    assert not len(m.commands.time)
    assert "no command before the last sample: nothing can be simulated again" in " ".join(m.notes)
    assert ("ta: left out 2 commands without a number" in m.notes) == (len(rows) == 2)


def test_a_log_that_is_only_a_header_holds_no_samples(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,qa,qb,ta,tb\n")
    with pytest.raises(MappingError, match="holds 0 samples"):
        read_log(load_mapping(mapping_file(tmp_path, CSV_MAPPING)), path)


def damaged_gzip(text: str) -> bytes:
    packed = bytearray(gzip.compress(text.encode(), mtime=0))
    packed[10] |= 0b110  # a kind of block that there is not
    return bytes(packed)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("run.csv.gz", damaged_gzip("t,qa,qb,ta,tb\n0,90,180,1,2\n"), "cannot be read .*invalid block type"),
        ("run.csv.gz", gzip.compress(b"t,qa\n0,90\n", mtime=0)[:-9], "cannot be read"),
        ("run.csv", b"t,qa,qb,ta,tb\n0,90,180,1," + b"2" * 200_000, "is no CSV .*field larger"),
        ("run.csv", b"t,qa,qb,ta,tb\r0,90,180,1,2\r", "is no CSV .*new-line"),
        ("run.json", b"[" * 200_000, "is no JSON"),
        ("run.json", json.dumps([dict.fromkeys(("t", "qa", "qb", "ta", "tb"), 10**400)] * 2).encode(), "is no number"),
    ],
)
def test_a_damaged_log_is_said_in_one_line(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MappingError, match=words) as error:
        read_log(load_mapping(mapping_file(tmp_path, CSV_MAPPING)), path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", sorted(built_in()))
def test_every_built_in_mapping_is_valid(name):
    assert load_mapping(name).joints


class TestRealLogs:
    pytestmark = real_data

    def test_every_servo_bench_recording(self, tmp_path):
        mapping = load_mapping("xl330_bench")
        logs = logs_in([DATA / "xl330_pendulum"], mapping)
        assert len(logs) == 12
        for path in logs:
            m = read_log(mapping, path)
            assert 5.9 < m.time[-1] < 6.1 and len(m.time) > 1000
            assert f"kp{m.scenario.constant('kp'):.0f}_" in path.name
            assert (m.commands.torque_on is not None) == ("drop" in path.name)
        assert differences(m, read_measurement(write_measurement(tmp_path, m))) == []

    def test_every_arm_motion(self, tmp_path):
        mapping = load_mapping("so101_arm")
        logs = logs_in([DATA / "so101_arm"], mapping)
        assert len(logs) == 8
        m = read_log(mapping, logs[0])
        assert m.joint_position.shape[1] == 6 and m.time[-1] > 30
        assert mapping.joints == tuple((logs[0] / "joint_list.txt").read_text().split())
        assert differences(m, read_measurement(write_measurement(tmp_path, m))) == []

    def test_every_double_pendulum_run(self, tmp_path):
        mapping = load_mapping("double_pendulum")
        logs = logs_in([DATA / "double_pendulum"], mapping)
        assert len(logs) == 5
        m = read_log(mapping, logs[0])
        assert m.joint_position.shape[1] == 2 and 4 < m.time[-1] < 11
        bag = write_measurement(tmp_path, m, torque_commands=True)
        assert differences(m, read_measurement(bag)) == []
