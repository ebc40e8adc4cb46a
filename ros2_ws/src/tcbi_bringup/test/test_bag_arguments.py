"""The commands that read bags: which robot is read, what is left out of `rollouts/*`, what is said of recordings."""

from pathlib import Path

import numpy as np
import pytest

from tcbi_bringup import cli
from tcbi_infer.bags.encoding import messages
from tcbi_infer.bags.recovery import recover
from tcbi_infer.bags.writer import BagWriter
from tcbi_sim.measurement import Commands, Measurement, Scenario

READERS = ("compare", "diagnose", "infer", "history", "add backlash")
START_NS = 5_000_000_000


def swing(samples: int = 400) -> Measurement:
    time = np.arange(samples) * 0.005
    commands = Commands(np.arange(0.0, time[-1], 0.2), np.sin(np.arange(0.0, time[-1], 0.2))[:, None])
    scenario = Scenario("log", float(time[-1]))
    position = np.sin(time)[:, None]
    return Measurement("swing", "servo_bench", scenario, "", "bench", commands, ("servo",), (), time, position)


def written(folder: Path, roots: tuple[str, ...] = ("/",), lost: tuple[float, float] = (0.0, 0.0)) -> Path:
    """A bag of one rollout under each root, without what came inside the stretch `lost` (s)."""
    first, last = (START_NS + round(t * 1e9) for t in lost)
    with BagWriter(folder, "swing") as bag:
        for root in roots:
            for topic, time, data in messages(swing(), START_NS):
                if not first < time < last:
                    bag.write(root + topic, time, data)
    return bag.path


def told(capsys, *words: object) -> str:
    """What a command says on standard error."""
    cli.main([str(w) for w in words])
    return capsys.readouterr().err


@pytest.mark.parametrize("command", READERS)
def test_of_several_robots_in_a_bag_one_is_chosen(command, tmp_path, capsys):
    bag = written(tmp_path, ("/left/", "/right/"))
    words = (*command.split(), bag, "--store", tmp_path)
    assert "2 robots ('left', 'right'); choose one with --namespace" in told(capsys, *words)
    assert "no joint_states under the namespace 'top'; it has 'left', 'right'" in told(
        capsys, *words, "--namespace", "top"
    )


def test_the_robot_that_was_chosen_is_read(tmp_path, capsys):
    bag = written(tmp_path, ("/left/", "/right/"))
    assert cli.main(["history", str(bag), "--namespace", "left", "--store", str(tmp_path), "--json"]) == 0


@pytest.mark.parametrize("command", READERS)
def test_a_damaged_original_beside_its_repaired_bag_is_left_out_in_a_line(command, tmp_path, capsys):
    file = written(tmp_path) / "swing_0.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    original = recover(file.parent).original
    words = (*command.split(), file.parent, original, "--namespace", "nowhere", "--store", tmp_path)
    line, refusal = told(capsys, *words).splitlines()
    assert line.startswith(f"note: {original} is left out: ") and "no joint_states under" in refusal


@pytest.mark.parametrize("command", ["history", "add --anyway backlash"])
def test_what_a_recording_lacks_is_said_before_it_is_used(command, tmp_path, capsys):
    bag = written(tmp_path, lost=(0.5, 1.0))
    said = told(capsys, *command.split(), bag, "--store", tmp_path)
    assert said.count("note: joint_states: 1 gap, 0.50 s in all") == 1
