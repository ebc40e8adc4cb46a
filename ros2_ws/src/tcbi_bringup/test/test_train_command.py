"""`./tcbi train` goes on from a policy with what that was trained with, unless something else is asked for."""

import argparse
import dataclasses
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tcbi_bringup.commands import train
from tcbi_bringup.errors import BringupError, WrongCallError
from tcbi_policy import artefact
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.errors import TrainingError
from tcbi_sim.store import ModelStore

LATE = ("command_latency",)


@pytest.mark.parametrize(
    ("words", "noise", "effects"),
    [
        ((), 0.0, ()),
        (("--start", "robust"), 0.02, LATE),
        (("--start", "robust", "--noise", "0"), 0.0, LATE),
        (("--start", "robust", "--effect", "lost_commands"), 0.02, ("lost_commands",)),
        (("--start", "balance", "--noise", "0.01"), 0.01, ()),
    ],
)
def test_what_a_policy_was_trained_with_stays_unless_something_else_is_asked_for(
    words: tuple[str, ...], noise: float, effects: tuple[str, ...], tmp_path: Path
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    also: dict[str, Any] = {"observation_noise": 0.02, "effects": list(LATE)}
    card = dataclasses.replace(shipped.card, name="robust", training={**shipped.card.training, **also})
    save_policy(tmp_path / "policies" / "robust", shipped.mlp, card)
    parser = argparse.ArgumentParser()
    train.add_arguments(parser)
    run = train.plan(parser.parse_args(["--task", "balance", *words]), ModelStore(tmp_path))
    assert (run.config.observation_noise, run.config.effects) == (noise, effects)


@pytest.mark.parametrize("out", ["..", ".", "/", ".safetensors", "files/..", "files/.safetensors", ".hidden"])
def test_a_policy_without_a_name_is_refused_before_the_training(out: str, tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    train.add_arguments(parser)
    with pytest.raises(WrongCallError, match=r"--out: got .*, allowed is a name"):
        train.plan(parser.parse_args(["--task", "balance", "--out", out]), ModelStore(tmp_path))


def planned(tmp_path: Path, *words: str) -> object:
    parser = argparse.ArgumentParser()
    train.add_arguments(parser)
    return train.plan(parser.parse_args(["--task", "balance", *words]), ModelStore(tmp_path))


def test_a_policy_that_is_there_is_not_written_over(tmp_path: Path) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    save_policy(tmp_path / "policies" / "mine", shipped.mlp, shipped.card)
    with pytest.raises(WrongCallError, match=r"--out: .*mine\.safetensors is there already; give another name"):
        planned(tmp_path, "--out", "mine")
    with pytest.raises(WrongCallError, match="is there already"):
        planned(tmp_path, "--out", str(tmp_path / "policies" / "mine.safetensors"))
    planned(tmp_path, "--out", "another")
    for folder in (f"{tmp_path}/policies", f"{tmp_path}/not-there/"):
        with pytest.raises(WrongCallError, match=r"--out: .* is a folder; add the policy's name"):
            planned(tmp_path, "--out", folder)


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("gait:stand", "allowed are letters, digits"),
        ("two words", "allowed are letters, digits"),
        ("balance.json", "without an ending"),
        ("balance", "'balance' is the name of a shipped policy, which it would hide"),
    ],
)
def test_a_name_that_could_not_be_told_from_another_policy_s_is_refused(tmp_path: Path, out: str, said: str) -> None:
    with pytest.raises(WrongCallError, match=f"--out: .*{said}"):
        planned(tmp_path, "--out", out)


def test_sac_does_not_go_on_from_a_policy(tmp_path: Path) -> None:
    with pytest.raises(WrongCallError, match=r"--start: the preset paper .*--preset fast"):
        planned(tmp_path, "--preset", "paper", "--start", "balance")


def test_a_place_that_cannot_be_written_to_is_refused_before_the_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (str(tmp_path / "file"), "/proc/nope"):
        with pytest.raises(BringupError, match=r"name a folder that can be written to"):
            planned(tmp_path, "--out", f"{folder}/walker.safetensors")


def test_a_gait_is_no_start_and_a_policy_of_another_task_is_said(tmp_path: Path, capsys) -> None:
    with pytest.raises(WrongCallError, match=r"--start: got gait:tripod, a scripted gait; allowed is a trained policy"):
        planned(tmp_path, "--start", "gait:tripod")
    planned(tmp_path, "--start", "forward")
    assert "was trained for forward; it goes on with balance" in capsys.readouterr().err


def test_an_effect_that_is_named_twice_is_refused_as_that(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="effect lost_commands is named twice"):
        planned(tmp_path, "--effect", "lost_commands", "--effect", "lost_commands")


def test_a_log_that_cannot_be_copied_is_one_line_after_the_policy_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    run = tmp_path / "run"
    save_policy(run / "policy", shipped.mlp, shipped.card)

    def full(*_: Path) -> None:
        raise shutil.Error([("from", "to", "[Errno 28] No space left on device: 'to'")])

    monkeypatch.setattr(shutil, "copytree", full)
    with pytest.raises(BringupError, match=r"saved as .*mine.safetensors, but .*No space left.* stays in .*run"):
        train._publish(run, "mine", tmp_path)
    assert find_policy("mine", tmp_path).policy_id.startswith("mine@") and run.is_dir()


def test_two_policies_without_a_name_that_are_kept_at_once_have_one_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    runs = [tmp_path / "runs" / name for name in "ab"]
    for run in runs:
        save_policy(run / "policy", shipped.mlp, shipped.card)
        (run / "tensorboard").mkdir()

    def slowly(*args: Any) -> Policy:
        time.sleep(0.3)
        return save_policy(*args)

    monkeypatch.setattr(artefact, "save_policy", slowly)
    with ThreadPoolExecutor(2) as pool:
        kept = [path for path, _ in pool.map(lambda run: train._publish(run, "", tmp_path), runs)]
    assert sorted(path.stem for path in kept) == ["balance-1", "balance-2"]


@pytest.mark.parametrize(
    ("words", "steps"),
    [((), 81_920), (("--steps", "77"), 77), (("--budget", "9"), 0), (("--budget", "9", "--steps", "77"), 77)],
)
def test_a_budget_in_seconds_stands_in_the_place_of_the_presets_steps(
    words: tuple[str, ...], steps: int, tmp_path: Path
) -> None:
    parser = argparse.ArgumentParser()
    train.add_arguments(parser)
    run = train.plan(parser.parse_args(["--task", "balance", *words]), ModelStore(tmp_path))
    assert (run.config.steps, run.config.budget_s) == (steps, 9.0 if "--budget" in words else 0.0)


def test_a_policy_is_kept_under_the_very_name_that_was_asked_for(tmp_path: Path) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    for out, path in (("v1.2", "policies/v1.2"), ("files/v1.2", "files/v1.2"), ("files/v1.safetensors", "files/v1")):
        run = tmp_path / "run"
        save_policy(run / "policy", shipped.mlp, shipped.card)
        (run / "tensorboard").mkdir()
        given = out if "/" not in out else str(tmp_path / out)
        assert train._publish(run, given, tmp_path)[0] == tmp_path / f"{path}.safetensors"
    assert (tmp_path / "files" / "v1.tensorboard").is_dir() and (tmp_path / "tensorboard" / "v1.2").is_dir()


@pytest.mark.parametrize(("total", "said"), [(640, "320 of 640 steps, "), (0, "320 steps, ")])
def test_progress_tells_the_steps_of_all_where_they_are_limited(total: int, said: str) -> None:
    notes: list[str] = []
    known = {"steps": 320, "total_steps": total, "share": 0.5, "remaining_s": 3.0, "mean_return": 1.0}
    train.follow({"event": "progress", **known}, lambda **shown: notes.append(shown["note"]))
    assert notes[0].startswith(said)


def test_an_evaluation_in_which_all_diverged_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    means = dict.fromkeys(("mean_return", "sd_return", "final_inclination_deg", "distance_m"))
    train.follow({"event": "evaluation", "steps": 0, "rollouts": 48, "diverged": 48, **means}, lambda **_: None)
    assert "0 steps: return nan" in (said := capsys.readouterr().err) and "48 of 48 diverged" in said
