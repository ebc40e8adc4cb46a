"""`./tcbi selftest`: its answer, its exit status, and how it is stopped; and that recommended commands can be typed."""

import json
import shlex

import pytest

from tcbi_bringup.cli import main
from tcbi_bringup.commands import collect
from tcbi_infer.diagnose.motions import standard_motions
from tcbi_sim.rigs import load_rig

SELFTEST = ["selftest", "--model", "servo_bench-v0", "--effects", "rotor_inertia", "--json"]


def result(robot, outcome: str) -> dict:
    """A result as a trial gives it."""
    found = {"outcome": outcome, "verdict": "effect", "uses": [robot.use], "planted": {}}
    return {"use": robot.use, "effect": robot.effect, "strength": robot.strength, "seed": robot.seed, **found,
            "error_before": 4.0, "error_after": 1.1}  # fmt: skip


@pytest.fixture
def outcomes(monkeypatch):
    """The outcomes of the robots, one after another (an exception is raised), and the robots that were asked for."""
    coming: list = []
    asked: list = []

    def trials(bench, robots, keep, progress):
        asked.extend(robots)
        for robot, outcome in zip(robots, coming, strict=False):
            if isinstance(outcome, type):
                raise outcome
            progress(robot, "recording", 0.5)
            yield result(robot, outcome)

    monkeypatch.setattr("tcbi_infer.selftest.trials", trials)
    return coming, asked


def test_what_is_found_passes(outcomes, capsys, tmp_path):
    outcomes[0][:] = ["right", "right"]
    assert main([*SELFTEST, "--store", str(tmp_path)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["passed"] and [r["use"] for r in answer["robots"]] == ["", "rotor_inertia"]
    assert "backlash" in answer["not_planted"] and "rotor_inertia" not in answer["not_planted"]
    assert answer["rows"][1] == {"effect": "rotor_inertia", "strength": "strong", "robots": 1, "right": 1, "unsure": 0,
                                 "wrong": 0, "missed": 0, "false alarm": 0}  # fmt: skip


@pytest.mark.parametrize(
    ("found", "options", "status"),
    [
        (["false alarm", "right"], [], 1),
        (["right", "missed"], [], 1),
        (["right", "unsure"], [], 0),
        (["right", "unsure"], ["--certain"], 1),
        (["right", "missed"], ["--most-missed", "1"], 0),
        (["false alarm", "right"], ["--most-false-alarms", "1"], 0),
    ],
)
def test_the_exit_status_is_fit_for_ci(outcomes, capsys, tmp_path, found, options, status):
    outcomes[0][:] = found
    assert main([*SELFTEST, "--store", str(tmp_path), *options]) == status
    assert json.loads(capsys.readouterr().out)["passed"] == (status == 0)


def test_an_effect_that_no_diagnosis_would_try_is_refused(outcomes, capsys, tmp_path):
    words = ["selftest", "--model", "hexapod-v0", "--effects", "joint_offset,backlash", "--store", str(tmp_path)]
    assert main(words) == 2 and not outcomes[1]
    told = capsys.readouterr().err
    assert "effects to plant: got 'joint_offset', allowed is those that a diagnosis tries: " in told
    assert "--full" in told


def test_an_interrupt_keeps_what_was_found_and_says_how_to_go_on(outcomes, capsys, tmp_path):
    outcomes[0][:] = ["right", KeyboardInterrupt]
    assert main([*SELFTEST, "--store", str(tmp_path)]) == 130
    told = capsys.readouterr()
    answer = json.loads(told.out)
    assert answer["stopped"] and not answer["passed"] and len(answer["robots"]) == 1
    assert "stopped after 1 of 2 robots" in told.err and "--keep" in told.err


def test_both_strengths_and_several_seeds_are_planted(outcomes, capsys, tmp_path):
    main([*SELFTEST, "--store", str(tmp_path), "--strength", "both", "--seeds", "2"])
    planned = [(r.use, r.strength, r.seed) for r in outcomes[1]]
    assert planned == [("", "none", 0), ("", "none", 1), *(
        ("rotor_inertia", strength, seed) for seed in (0, 1) for strength in ("strong", "weak")
    )]  # fmt: skip


def test_the_command_that_a_diagnosis_recommends_is_one_that_collect_takes():
    import argparse

    parser = argparse.ArgumentParser()
    collect.add_arguments(parser)
    for motion in standard_motions(load_rig("hexapod"), 3.0):
        body = motion.command.partition("; do ./tcbi collect ")[2].removesuffix("; done")
        args = parser.parse_args(shlex.split(body))
        assert args.policy == motion.name and args.duration == motion.scenario.duration
        assert args.slope_roll[0] == pytest.approx(motion.scenario.slope_roll, abs=1e-4)
