"""The commands that need no graph, as a user calls them: import, recover, replay's refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from rclpy.node import Node

from tcbi_bringup import cli
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.bags.writer import BagWriter
from tcbi_sim.measurement import Commands, Measurement, Scenario


def log(folder: Path, name: str = "run_1.json") -> Path:
    samples = [
        {"timestamp": k * 0.005, "position": 0.01 * k, "goal_position": 0.3, "torque_enable": k < 150}
        for k in range(200)
    ]
    path = folder / name
    path.write_text(json.dumps({"kp": 200, "mass": 0.49, "length": 0.1, "vin": 7.4, "entries": samples}))
    return path


def bag(folder: Path, name: str = "swing") -> Path:
    time = np.arange(500) * 0.005
    commands = Commands(np.array([0.0]), np.zeros((1, 1)), 0.0)
    scenario = Scenario("log", float(time[-1]))
    made = Measurement(
        name, "servo_bench", scenario, "", "bench", commands, ("servo",), (), time, np.sin(time)[:, None]
    )
    return write_measurement(folder, made)


def cut(bag: Path) -> Path:
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    return bag


def test_import_writes_a_bag_a_log_and_tells_it_as_json(tmp_path, capsys):
    log(tmp_path), log(tmp_path, "run_2.json")
    assert cli.main(["import", "xl330_bench", str(tmp_path), "--out", str(tmp_path / "bags"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["rig"] == "motor_bench"
    assert [Path(b["bag"]).name for b in told["bags"]] == ["run_1", "run_2"]
    m = read_measurement(told["bags"][0]["bag"])
    assert m.scenario.constant("kp") == 200 and len(m.time) == 200 == told["bags"][0]["samples"]


def test_a_bad_log_among_good_ones_leaves_nothing_behind(tmp_path, capsys):
    log(tmp_path)
    (tmp_path / "run_2.json").write_text("[]")
    assert cli.main(["import", "xl330_bench", str(tmp_path), "--out", str(tmp_path / "bags")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "bags").exists()


def test_recover_repairs_and_says_what_was_saved(tmp_path, capsys):
    path = bag(tmp_path)
    cut(path)
    assert cli.main(["recover", str(path), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["bags"]
    assert told["error"] is None and told["repaired"] and told["bag"] == str(path) and Path(told["original"]).is_dir()
    assert told["messages"] == sum(told["topics"].values()) > 100
    assert told["seconds"] == pytest.approx(read_measurement(path).time[-1], abs=0.01)
    assert cli.main(["recover", str(path)]) == 0
    assert "nothing to repair" in capsys.readouterr().err


@pytest.mark.parametrize("as_json", [False, True])
def test_recover_tells_of_every_bag_and_fails_if_one_cannot_be_repaired(tmp_path, capsys, as_json):
    first, last = cut(bag(tmp_path, "a")), cut(bag(tmp_path, "c"))
    (tmp_path / "b.mcap").write_bytes(b"\x89MCAP0\r\n")
    options = ["--json"] if as_json else []
    assert cli.main(["recover", *map(str, sorted(tmp_path.iterdir())), *options]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "b.mcap: the bag is empty, it holds not one message" in captured.err
    assert (tmp_path / "a.damaged").is_dir() and (tmp_path / "c.damaged").is_dir()
    if as_json:
        told = json.loads(captured.out)["bags"]
        assert [(b["bag"], b["repaired"]) for b in told] == [
            (str(first), True), (str(tmp_path / "b.mcap"), False), (str(last), True),
        ]  # fmt: skip
        assert [b["error"] is None for b in told] == [True, False, True] and "not one" in told[1]["error"]
    else:
        assert captured.out.count("the original is kept as") == 2


def test_recover_leaves_the_originals_of_earlier_repairs_alone(tmp_path, capsys):
    assert cli.main(["recover", str(cut(bag(tmp_path)))]) == 0
    capsys.readouterr()
    assert cli.main(["recover", *map(str, sorted(tmp_path.iterdir()))]) == 0
    told = capsys.readouterr().err.splitlines()
    assert "swing.damaged is left out: it is the damaged original that a repair kept" in told[0]
    assert "nothing to repair" in told[1]
    assert cli.main(["recover", str(tmp_path / "swing.damaged")]) == 1
    assert "rename it first" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["swing", "swing.damaged"]


@pytest.mark.parametrize("command", ["compare", "recover", "replay"])
@pytest.mark.parametrize(
    ("what", "content", "remedy"),
    [
        ("missing", None, "give a bag's folder or an .mcap file"),
        (".", None, "give a bag's folder or an .mcap file"),
        ("text.mcap", b"hello, I am a text of some length", "give a bag that was recorded as MCAP"),
        ("passwd", b"root:x:0:0", "passwd: is no bag, allowed are a bag's folder and an .mcap file; give one of these"),
        ("old.db3", b"SQLite format 3\0", "rosbags-convert --src "),
        ("whole.mcap.zstd", b"\x28\xb5\x2f\xfd", "unzstd whole.mcap.zstd"),
        ("empty.mcap", b"", "it holds not one message (empty.mcap: the file has no bytes); leave it out, or record it"),
        ("begun.mcap", b"\x89MCAP0\r\n", "not one message (begun.mcap: the recording was never closed); leave it out"),
        ("cut.mcap", b"\x89MCAP0\r\n\1\0", "not one message can be read, 2 bytes are lost (cut.mcap: the file ends"),
    ],
)
def test_what_is_no_bag_is_one_line_that_says_what_to_do_and_status_1(tmp_path, capsys, command, what, content, remedy):
    if content is not None:
        (tmp_path / what).write_bytes(content)
    assert cli.main([command, str(tmp_path / what)]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and remedy in captured.err
    assert ("rosbags-convert" in captured.err) == (what == "old.db3") and "recover writes" not in captured.err


def test_a_sound_bag_without_messages_is_told_to_be_empty(tmp_path, capsys):
    with BagWriter(tmp_path, "nothing") as writer:
        pass
    assert cli.main(["recover", str(writer.path)]) == 0
    assert "nothing to repair, 0 messages; the bag is empty, leave it out or record it again" in capsys.readouterr().err
    assert cli.main(["replay", str(writer.path)]) == 1
    assert "the bag is empty, it holds not one message; leave it out, or record it again" in capsys.readouterr().err


def test_replay_does_not_move_a_robot_that_listens(tmp_path, capsys, peer):
    robot = Node("driver_node", context=peer.node.context)
    bag = tmp_path / "bags" / "run_1"
    assert cli.main(["import", "xl330_bench", str(log(tmp_path)), "--out", str(tmp_path / "bags")]) == 0
    capsys.readouterr()
    assert cli.main(["replay", str(bag)]) == 1
    robot.destroy_node()
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "/driver_node runs in ROS domain" in told and "--drive" in told
    assert "its joint_commands would move it, its joint_states would mix" in told


def test_replay_does_not_speak_in_the_place_of_a_robot_that_runs(tmp_path, capsys, peer):
    robot = Node("sim_node", context=peer.node.context)
    for words in (["--topics", "joint_states"], ["--drive"]):
        assert cli.main(["replay", str(bag(tmp_path / words[0])), *words]) == 1
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and "/sim_node runs" in told and "would move" not in told
        assert "its joint_states would mix with what is measured now" in told and "./tcbi up --robot none" in told
    robot.destroy_node()


def test_collect_names_every_fault_before_it_starts_anything(capsys):
    assert cli.main(["collect", "--slope-roll", "2", "--duration", "9999", "--robot", "sim"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "duration_s: got 9999" in told and "slope_roll: got 2" in told


@pytest.mark.parametrize("command", ["collect", "recover", "replay", "import"])
def test_help_shows_examples(capsys, command):
    assert cli.main([command, "--help"]) == 0
    assert f"./tcbi {command} " in capsys.readouterr().out
