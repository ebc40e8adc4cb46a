"""Attempts against a rival: how they are counted, and how sure each must be."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from retraining_cases import job, robust, tiny

from tcbi_policy import attempts, retraining, training_process
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.attempts import FALSE_ALARMS, confidence, next_attempt, verdict_in
from tcbi_policy.errors import TrainingError
from tcbi_policy.evaluation import Comparison
from tcbi_policy.gaits import Gait
from tcbi_policy.retraining import AGAIN, OUTCOME, plan
from tcbi_policy.runs import write_run
from tcbi_policy.training import Training
from tcbi_policy.training_process import judge, train_run
from tcbi_sim.store import ModelStore

__all__ = ["tiny"]  # the fixture

pytestmark = pytest.mark.usefixtures("tiny")


def test_all_attempts_together_are_wrong_as_seldom_as_one_may_be() -> None:
    assert (confidence(1), confidence(2)) == (pytest.approx(0.975), pytest.approx(1 - 0.05 / 6))
    spent = sum(1 - confidence(attempt) for attempt in range(1, 10_000))
    assert 0.999 * FALSE_ALARMS < spent <= FALSE_ALARMS


def test_every_attempt_has_rollouts_and_a_confidence_of_its_own_and_says_which_it_is(tmp_path: Path) -> None:
    policy, rival = robust(tmp_path), Gait("stand")
    run = dataclasses.replace(plan(job(tmp_path, current="robust")), pairs=4)
    model = ModelStore(tmp_path).load(run.model)
    first, again, second = (judge(rival, policy, model, run, attempt) for attempt in (1, 1, 2))
    assert first == again and first["before"] != second["before"]
    for attempt, found, sure in ((1, first, "97.5"), (2, second, "99.17")):
        assert found["attempt"] == attempt and found["confidence"] == confidence(attempt)
        assert f"with {sure} % confidence, attempt {attempt} against gait:stand on hexapod-v0" in found["statement"]


def verdict(attempt: int, **changes: str) -> dict[str, Any]:
    return {"rival": "balance@1", "model": "hexapod-v1", "task": "balance", "attempt": attempt, **changes}


def test_attempts_are_counted_by_the_verdicts_kept_on_this_rival_model_and_task_alone(tmp_path: Path) -> None:
    def attempt() -> int:
        return next_attempt(tmp_path, "balance@1", "hexapod-v1", "balance")

    def keep(name: str, found: dict[str, Any]) -> None:
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / OUTCOME).write_text(json.dumps(found))

    assert attempt() == 1
    keep("another rival", verdict(7, rival="balance@2"))
    keep("another model", verdict(8, model="hexapod-v2"))
    keep("another task", verdict(9, task="forward"))
    keep("older", {"rival": "balance@1", "better": False})
    assert attempt() == 1
    keep("first", verdict(1))
    assert attempt() == 2
    robust(tmp_path, comparison=verdict(2))
    assert attempt() == 3, "an accepted policy's card counts, too"
    keep("damaged", {})
    (tmp_path / "runs" / "damaged" / OUTCOME).write_text("{")
    with pytest.raises(TrainingError, match=r"damaged/outcome\.json cannot be read"):
        attempt()


def test_an_attempt_that_is_accepted_while_attempts_are_counted_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its verdict moves from the folder of its run to a card, and the folder goes."""
    folder = tmp_path / "runs" / "first"
    folder.mkdir(parents=True)
    (folder / OUTCOME).write_text(json.dumps(verdict(1)))

    def accepted_after(read: Callable[..., Any]) -> Callable[..., Any]:
        def reading(*args: Any) -> Any:
            found = read(*args)
            robust(tmp_path, comparison=verdict(1))
            shutil.rmtree(folder, ignore_errors=True)
            return found

        return reading

    for name in ("load_all", "verdict_in"):
        monkeypatch.setattr(attempts, name, accepted_after(getattr(attempts, name)))
    assert next_attempt(tmp_path, "balance@1", "hexapod-v1", "balance") == 2


def test_a_verdict_that_vanishes_as_it_is_read_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda _: True)  # a moment ago
    assert verdict_in(tmp_path) == {}


def test_a_training_that_finds_nothing_better_than_its_rival_is_no_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes out of the trainings is given here; one that was an attempt stays counted."""
    run = dataclasses.replace(plan(job(tmp_path)), pairs=2)
    folder = write_run(tmp_path / "runs" / "retrain-balance-x", run)
    rival = find_policy("balance")
    assert isinstance(rival, Policy)
    other = dataclasses.replace(rival, card=dataclasses.replace(rival.card, sha256="another"))
    verdicts: list[dict[str, Any]] = []
    counts: list[int] = []
    for trained in (rival, other, rival):
        monkeypatch.setattr(Training, "run", lambda _, trained=trained: trained)
        train_run(folder, lambda event: verdicts.append(event) if event["event"] == "comparison" else None)
        counts.append(next_attempt(tmp_path, rival.policy_id, run.model, "balance"))
    assert counts == [1, 2, 2]
    assert "attempt" not in verdicts[0] and not verdicts[0]["better"] and verdicts[0]["before"] is not None
    assert verdicts[0]["statement"].startswith(f"not better: the training found nothing better than {rival.policy_id}")


def test_another_network_is_another_attempt_and_the_same_one_has_its_verdict_already(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes out of the trainings is given here."""
    run = dataclasses.replace(plan(job(tmp_path, current="gait:stand")), pairs=2)
    folder = write_run(tmp_path / "runs" / "retrain-balance-x", run)
    shipped, compared = find_policy("balance"), training_process.compare_held_out
    assert isinstance(shipped, Policy)
    other = dataclasses.replace(shipped, card=dataclasses.replace(shipped.card, sha256="another"))
    looks: list[int] = []

    def looked(*args: Any) -> Any:
        looks.append(args[-1])
        return compared(*args)

    monkeypatch.setattr(training_process, "compare_held_out", looked)
    told: list[dict[str, Any]] = []
    for trained in (shipped, shipped, other):
        monkeypatch.setattr(Training, "run", lambda _, trained=trained: trained)
        train_run(folder, told.append)
    verdicts = [event for event in told if event["event"] == "comparison"]
    assert looks == [1, 2]
    assert [found["attempt"] for found in verdicts] == [1, 1, 2]
    assert [found.get(AGAIN, False) for found in verdicts] == [False, True, False]
    assert json.loads((folder / OUTCOME).read_text()) == json.loads(json.dumps(verdicts[-1]))


def test_weights_that_were_accepted_have_their_verdict_when_they_are_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of their run is gone by then. Against another rival they are judged, and kept once all the same."""
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    looks: list[int] = []

    def better(*args: Any) -> Comparison:
        looks.append(args[-1])
        return Comparison(1.0, 1.0, 2, 2, 2, 0, 0, 0.975, 1.0, 2.0)

    def trained(folder: Path, *_: Any) -> dict[str, Any]:
        told: list[dict[str, Any]] = []
        save_policy(folder / "policy", shipped.mlp, shipped.card)
        train_run(folder, told.append)
        return dict(json.loads(json.dumps(told[-1])))

    monkeypatch.setattr(Training, "run", lambda _: shipped)
    monkeypatch.setattr(training_process, "compare_held_out", better)
    monkeypatch.setattr(retraining, "_follow", trained)
    rivals = ("stand", "stand", "squat")
    outcomes = [retraining.retrain(job(tmp_path, current=f"gait:{rival}"), print) for rival in rivals]
    assert [outcome.reference for outcome in outcomes] == ["balance-1"] * 3
    again = f"{outcomes[0].message} (the same weights as before, whose verdict stands)"
    assert dataclasses.replace(outcomes[0], message=again) == outcomes[1] and looks == [1, 1]
    model = ModelStore(tmp_path).load("latest").version
    assert [next_attempt(tmp_path, f"gait:{gait}", model, "balance") for gait in ("stand", "squat")] == [2, 2]
