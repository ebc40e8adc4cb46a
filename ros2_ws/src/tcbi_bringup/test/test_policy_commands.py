"""`./tcbi policy --onnx` and `./tcbi tasks`: one answer, one line for each fault, exit status."""

import dataclasses
import json
from pathlib import Path

import pytest

from tcbi_bringup import cli
from tcbi_policy.artefact import Policy, find_policy, newest_policy, save_policy

WAIT = """
from tcbi_policy.reward import action_term
from tcbi_sim.measurement import Scenario
from tcbi_sim.tasks import Task

TASK = Task("wait", {duration}, "stand and wait", 0, lambda rng, seed=0: Scenario("wait", {duration}, seed=seed),
            reward=(action_term(-600.0),))
"""


def test_a_policy_is_exported_with_its_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "balance.onnx"
    assert cli.main(["policy", "balance", "--onnx", str(file), "--store", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["onnx"] == str(file)
    data = file.read_bytes()
    assert b"Gemm" in data and b'"task": "balance"' in data and len(data) > 4 * 256 * 256


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("gait:stand", "--onnx", "x.onnx"), "no network to export"),
        (("balance", "--onnx", "nowhere/x.onnx"), "nowhere is no folder"),
        (("balance", "--onnx", "balance.json"), "--onnx: got balance.json, allowed is a file of the ending .onnx"),
        (("balance", "--onnx", "/"), "--onnx: / is a folder; name a file, such as /balance.onnx"),
    ],
)
def test_what_cannot_be_exported_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], said: str
) -> None:
    assert cli.main(["policy", *words, "--store", str(tmp_path)]) == 1
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_tasks_are_listed_with_terms_and_units_those_of_ones_own_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "wait.py").write_text(WAIT.format(duration=4.0))
    assert cli.main(["tasks", "--store", str(tmp_path), "--json"]) == 0
    found = {task["task"]: task for task in json.loads(capsys.readouterr().out)["tasks"]}
    assert list(found) == ["balance", "forward", "wait"]
    assert [(t["weight"], t["unit"]) for t in found["forward"]["terms"]] == [
        (90000, "m"),
        (9000, "rad"),
        (-600, "rad^2"),
    ]


def test_a_task_is_shown_with_what_its_scenarios_are_like(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks", "show", "forward", "--store", str(tmp_path), "--json"]) == 0
    scenarios = {row["what"]: row for row in json.loads(capsys.readouterr().out)["scenarios"]}
    assert 0.06 <= scenarios["height of a block"]["low"] < 0.061 and scenarios["height of a block"]["high"] > 0.079
    assert "slope of the ground" not in scenarios, "what is always 0 is left out"
    assert cli.main(["tasks", "show", "balance", "--store", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "slope of the ground" in said and "block" not in said and "- 600 /rad^2" in said


def test_a_check_says_what_is_wrong_and_ends_with_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "wait.py"
    file.write_text(WAIT.format(duration=4.1))
    assert cli.main(["tasks", "check", str(file)]) == 1
    assert "multiples of the control period" in capsys.readouterr().out
    file.write_text(WAIT.format(duration=4.0))
    assert cli.main(["tasks", "check", str(file)]) == 0
    assert "fit for use" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lost", "status", "said"),
    [(".json", 1, "its card mine.json is missing beside it; copy both files again"), (".safetensors", 2, "not exist")],
)
def test_a_file_that_is_not_there_is_a_wrong_call_and_a_policy_without_its_card_a_damaged_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], lost: str, status: int, said: str
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    save_policy(tmp_path / "mine", shipped.mlp, dataclasses.replace(shipped.card, name="mine"))
    (tmp_path / f"mine{lost}").unlink()
    assert cli.main(["policy", str(tmp_path / "mine.safetensors"), "--store", str(tmp_path)]) == status
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1


def test_a_damaged_policy_is_left_out_with_a_note_that_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    policies = tmp_path / "policies"
    save_policy(policies / "mine", shipped.mlp, dataclasses.replace(shipped.card, name="mine", created="2026"))
    save_policy(policies / "damaged", shipped.mlp, dataclasses.replace(shipped.card, name="damaged", created="2027"))
    (policies / "damaged.json").write_text("{")
    assert cli.main(["policy", "--store", str(tmp_path), "--json"]) == 0
    captured = capsys.readouterr()
    listed = [p["policy_id"].partition("@")[0] for p in json.loads(captured.out)["policies"]]
    assert "mine" in listed and "damaged" not in listed
    assert "left out" in captured.err and "damaged.safetensors" in captured.err and captured.err.count("\n") == 1
    name, faults = newest_policy("balance", tmp_path)
    assert name == "mine" and "damaged.safetensors" in str(faults)
