"""Retraining: only what is better with confidence is accepted, and the job says so either way."""

import contextlib
import dataclasses
import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from retraining_cases import TINY, job, robust, tiny

from tcbi_contract.errors import TcbiError
from tcbi_policy import artefact, retraining, runs, training_process
from tcbi_policy.artefact import Policy, find_policy, keep_policy, load_policy, locked, policy_paths, save_policy
from tcbi_policy.errors import PolicyMisfit, PolicyNotFound, TrainingError
from tcbi_policy.evaluation import draw_conditions, evaluate, noisy
from tcbi_policy.gaits import Gait
from tcbi_policy.randomisation import divided, randomised
from tcbi_policy.retraining import OUTCOME, next_name, plan, publish, randomisation_of, reference_of, retrain, rival_for
from tcbi_policy.runs import Run, TrainingProcess, write_run
from tcbi_policy.training import Training
from tcbi_policy.training_process import ACCEPTANCE_SEED, compare_held_out, train_run
from tcbi_sim.store import ModelStore

__all__ = ["tiny"]  # the fixture

pytestmark = pytest.mark.usefixtures("tiny")
SUBPROCESS = pytest.mark.timeout(400)  # it imports torch, which takes its time on a busy machine


def test_a_trained_policy_is_where_training_goes_on_unless_scratch_is_asked_for(tmp_path: Path) -> None:
    assert plan(job(tmp_path)).start == "balance"
    assert plan(job(tmp_path)).config.warm_up == 2
    assert plan(job(tmp_path, start="none")).start == ""
    assert plan(job(tmp_path, current="gait:stand")).start == ""
    assert plan(job(tmp_path)).model == "hexapod-v0"


def test_a_policy_of_another_task_is_no_start(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="task of policy balance: got 'balance', allowed is forward"):
        plan(job(tmp_path, task="forward", current="gait:tripod", start="balance"))
    with pytest.raises(TrainingError, match="trained policy"):
        plan(job(tmp_path, start="gait:stand"))


def settings_of(run: Run) -> tuple[float, tuple[str, ...], float]:
    return run.config.observation_noise, run.config.effects, run.config.effect_share


RANDOMISATION: dict[str, Any] = {
    "observation_noise": 0.02,
    "effects": ["command_latency", "lost_commands"],
    "effect_share": 0.25,
}


def test_the_successor_of_a_robust_policy_meets_what_that_was_trained_with(tmp_path: Path) -> None:
    robust(tmp_path, **RANDOMISATION)
    expected = (0.02, ("command_latency", "lost_commands"), 0.25)
    assert settings_of(plan(job(tmp_path, current="robust"))) == expected
    assert settings_of(plan(job(tmp_path, current="gait:stand", start="robust"))) == expected
    assert settings_of(plan(job(tmp_path, current="robust", start="none"))) == expected
    words = "noise of 0.02 rad on the observation and command_latency, lost_commands in 25% of the episodes"
    assert plan(job(tmp_path, current="robust")).config.randomisation() == words
    robust_one, model = find_policy("robust", tmp_path), ModelStore(tmp_path).load("hexapod-v0")
    assert randomisation_of(robust_one, "forward", model) == {}


def test_effects_that_the_model_has_by_now_are_not_added_again(tmp_path: Path) -> None:
    robust(tmp_path, **RANDOMISATION)
    store = ModelStore(tmp_path)
    version = store.save(store.load("hexapod-v0").with_effect("command_latency")).version
    run = plan(job(tmp_path, current="robust", model=version))
    assert settings_of(run) == (0.02, ("lost_commands",), 0.25)


def test_a_policy_trained_without_either_is_retrained_as_the_preset_says(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"seed": 3, "observation_noise": 0.0, "effects": (), "effect_share": 0.5}
    expected = dataclasses.replace(retraining.fine_tuning(TINY), **changes)
    assert plan(job(tmp_path, seed=3)).config == expected
    assert expected.randomisation() == ""


def test_an_effect_that_exists_no_more_is_refused_before_anything_starts(tmp_path: Path) -> None:
    robust(tmp_path, effects=["magic"], effect_share=0.5)
    with pytest.raises(TcbiError, match="magic"):
        plan(job(tmp_path, current="robust"))


@pytest.mark.parametrize("randomised_too", [False, True])
def test_both_are_compared_under_the_conditions_of_the_training(tmp_path: Path, randomised_too: bool) -> None:
    """Measured apart: what the comparison says of the rival is its return under these conditions, and no other."""
    policy = robust(tmp_path, **RANDOMISATION if randomised_too else {})
    run = dataclasses.replace(plan(job(tmp_path, current="robust")), pairs=3)
    model, rival = ModelStore(tmp_path).load(run.model), Gait("stand")
    found = compare_held_out(rival, policy, model, run)
    if randomised_too:
        model = randomised(model, ("command_latency", "lost_commands"), 0.25, ACCEPTANCE_SEED)
    conditions = draw_conditions(model, "balance", 3, ACCEPTANCE_SEED, systematic=True)
    sigma = 0.02 if randomised_too else 0.0
    before, after = (evaluate(noisy(p, sigma), model, conditions).mean_return for p in (rival, policy))
    assert (found.before, found.after) == (before, after)
    assert (after == evaluate(policy, model, conditions).mean_return) != randomised_too  # the noise does something


def test_equal_vectors_are_one_whatever_effects_they_are_drawn_with(tmp_path: Path) -> None:
    policy = robust(tmp_path, **RANDOMISATION)
    run = dataclasses.replace(plan(job(tmp_path, current="robust")), pairs=6)
    model = ModelStore(tmp_path).load(run.model)
    model = model.with_particles(model.particles[np.arange(12) % 3])
    found = compare_held_out(Gait("stand"), policy, model, run)
    assert (found.pairs, found.vectors) == (6, 3)
    assert "on 6 held-out rollouts of 3 parameter draws" in found.statement()


def test_the_returns_of_an_outcome_without_a_verdict_are_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing: dict[str, Any] = {"better": False, "statement": "not better", "rival": "gait:stand", "gain": None}
    found = {"event": "comparison", "before": None, "after": None, **nothing}
    monkeypatch.setattr(retraining, "_follow", lambda *_: found)
    outcome = retrain(job(tmp_path), lambda event: None)
    assert math.isnan(outcome.return_before) and math.isnan(outcome.return_after)


def test_a_start_of_other_widths_is_refused_by_name_before_anything_starts(tmp_path: Path) -> None:
    narrow = small(tmp_path)
    with pytest.raises(TrainingError, match=r"hidden layers of policy small@\w+: got \(8,\), allowed is \(256, 256\)"):
        plan(job(tmp_path, current="small"))
    assert plan(job(tmp_path, current="small", start="none")).start == ""
    with pytest.raises(TrainingError, match="hidden layers"):
        Training(tmp_path, TINY, ModelStore(tmp_path).load("hexapod-v0"), start=narrow)


def small(tmp_path: Path) -> Policy:
    """A policy in the store that runs, but with one narrow layer."""
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    mlp = shipped.mlp
    narrow = dataclasses.replace(
        mlp, weights=(mlp.weights[0][:8], mlp.weights[-1][:, :8]), biases=(mlp.biases[0][:8], mlp.biases[-1])
    )
    return save_policy(tmp_path / "policies" / "small", narrow, dataclasses.replace(shipped.card, name="small"))


def test_a_seed_beyond_what_the_libraries_take_is_refused(tmp_path: Path) -> None:
    assert plan(job(tmp_path, seed=2**32 - 1)).config.seed == 2**32 - 1
    with pytest.raises(TrainingError, match="seed: got 4294967296, allowed is 0 to 4294967295"):
        plan(job(tmp_path, seed=2**32))


def test_the_budget_of_the_request_holds(tmp_path: Path) -> None:
    config = plan(job(tmp_path, budget_s=12.0, budget_steps=77, seed=5)).config
    assert (config.budget_s, config.steps, config.seed) == (12.0, 77, 5)


@pytest.mark.parametrize("budget_s", [float("nan"), float("inf"), -1.0])
def test_a_budget_that_is_no_time_is_refused(tmp_path: Path, budget_s: float) -> None:
    with pytest.raises(TrainingError, match=r"budget_s: got .*allowed is 0"):
        plan(job(tmp_path, budget_s=budget_s))


def test_a_model_of_another_robot_is_refused_by_what_differs(tmp_path: Path) -> None:
    with pytest.raises(PolicyMisfit, match=r"on so101_arm-v0\) does not fit this robot: .*observation lacks Rotation"):
        plan(job(tmp_path, model="so101_arm-v0"))


def test_a_budget_in_seconds_alone_has_no_limit_in_steps(tmp_path: Path) -> None:
    for start in ("", "none"):
        config = plan(job(tmp_path, start=start, budget_s=12.0)).config
        assert (config.budget_s, config.steps) == (12.0, 0)
        assert plan(job(tmp_path, start=start)).config.steps == TINY.steps


def test_the_same_job_has_the_same_folder_and_another_one_another(tmp_path: Path) -> None:
    keys = [plan(job(tmp_path, seed=seed)).key("retrain") for seed in (0, 0, 1)]
    assert keys[0] == keys[1] != keys[2]


def test_a_policy_or_a_file_of_ones_own_that_has_changed_makes_it_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TCBI_TASKS", str(tmp_path / "tasks"))
    (tmp_path / "tasks").mkdir()
    robust(tmp_path)
    keys = [plan(job(tmp_path, current="robust")).key("retrain")]
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    other = dataclasses.replace(shipped.mlp, biases=tuple(b + 0.01 for b in shipped.mlp.biases))
    save_policy(tmp_path / "policies" / "robust", other, dataclasses.replace(shipped.card, name="robust"))
    keys.append(plan(job(tmp_path, current="robust")).key("retrain"))
    (tmp_path / "tasks" / "mine.py").write_text("WEIGHT = 1.0")
    keys.append(plan(job(tmp_path, current="robust")).key("retrain"))
    assert len(set(keys)) == 3


def test_a_run_on_other_code_or_libraries_is_another_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = [plan(job(tmp_path)).key("retrain")]
    for name, found in (("code", lambda packages: "changed"), ("library_versions", lambda: {"torch": "99"})):
        monkeypatch.setattr(runs, name, found)
        assert plan(job(tmp_path)).key("retrain") == keys[-1], "what a process has loaded stays the same"
        monkeypatch.setattr(runs, "LOADED", runs.installed())  # in a process that starts now
        keys.append(plan(job(tmp_path)).key("retrain"))
    assert len(set(keys)) == 3


def test_a_run_on_other_code_than_the_process_that_would_train_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_run(tmp_path / "run", plan(job(tmp_path)))
    monkeypatch.setattr(training_process, "LOADED", "code changed")
    with pytest.raises(TrainingError, match=r"changed after the program .* had started; restart that"):
        train_run(folder, lambda event: None)


def test_a_training_without_a_comparison_draws_no_particle_that_others_are_judged_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []

    class Watched(Training):
        def run(self) -> Policy:
            drawn.append(self.model)
            return super().run()

    monkeypatch.setattr(training_process, "Training", Watched)
    store = ModelStore(tmp_path)
    model = store.load("hexapod-v0")
    train_run(write_run(tmp_path / "run", Run.of(TINY, model, store.root)), lambda event: None)
    kept, held_out = divided(model)
    assert len(held_out.particles) and np.array_equal(drawn[0].particles, kept.particles)


def test_two_policies_that_are_kept_at_once_have_a_name_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One is still being written when the other one looks for a name."""
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    folders = [tmp_path / "runs" / name for name in "ab"]
    for number, folder in enumerate(folders):
        biases = tuple(b + number for b in shipped.mlp.biases)
        save_policy(folder / "policy", dataclasses.replace(shipped.mlp, biases=biases), shipped.card)

    def slowly(*args: Any) -> Policy:
        time.sleep(0.3)
        return save_policy(*args)

    monkeypatch.setattr(retraining, "save_policy", slowly)
    with ThreadPoolExecutor(2) as pool:
        kept = list(pool.map(lambda folder: publish(folder, tmp_path, "balance"), folders))
    assert sorted(policy.card.name for policy in kept) == ["balance-1", "balance-2"]
    for folder, policy in zip(folders, kept, strict=True):
        own = load_policy(folder / "policy.safetensors").card.sha256
        assert find_policy(policy.card.name, tmp_path).policy_id == f"{policy.card.name}@{own[:8]}"
        # as after a kill between keeping it and removing its run
        assert publish(folder, tmp_path, "balance").policy_id == policy.policy_id
    assert "balance-3" not in policy_paths(tmp_path)


@SUBPROCESS
def test_a_job_ends_with_a_verdict_and_only_a_better_policy_is_kept(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    outcome = retrain(job(tmp_path), events.append)
    assert next(e for e in events if e["event"] == "comparison")["pairs"] == 64
    assert ("held-out" in outcome.message or "this is no attempt" in outcome.message) and not outcome.cancelled
    assert outcome.rival == find_policy("balance").policy_id
    assert outcome.accepted == (next_name(tmp_path, "balance") == "balance-2")
    assert outcome.accepted == bool(outcome.reference)
    assert Path(outcome.path).exists()
    if not outcome.accepted:
        kept = json.loads((Path(outcome.path).parent / OUTCOME).read_text())
        assert (kept["before"], kept["after"]) == (outcome.return_before, outcome.return_after)


@SUBPROCESS
def test_a_worse_successor_is_not_kept_and_the_verdict_says_so(tmp_path: Path) -> None:
    """From scratch, after 320 steps, against a policy of 160 processor seconds."""
    outcome = retrain(job(tmp_path, start="none"), lambda event: None)
    assert not outcome.accepted and outcome.reference == ""
    assert outcome.message.startswith("not better with confidence: return")
    assert outcome.return_after < outcome.return_before - 100
    assert next_name(tmp_path, "balance") == "balance-1", "nothing was kept"


@SUBPROCESS
def test_a_hopeless_rival_is_replaced_by_a_policy_with_a_name_of_its_own(tmp_path: Path) -> None:
    robust(tmp_path, observation_noise=0.01)
    outcome = retrain(job(tmp_path, current="gait:dither", start="robust", budget_steps=1), lambda event: None)
    assert outcome.accepted and outcome.reference == "balance-1"
    assert outcome.return_after > outcome.return_before
    policy = find_policy("balance-1", tmp_path)
    assert isinstance(policy, Policy) and policy.policy_id.startswith("balance-1@")
    assert policy.card.training["comparison"]["after"] == outcome.return_after
    assert policy.card.training["observation_noise"] == 0.01
    assert outcome.message.endswith("both with noise of 0.01 rad on the observation")
    assert reference_of(policy.policy_id, tmp_path) == "balance-1"


@SUBPROCESS
def test_a_cancelled_job_ends_within_a_second_and_goes_on_later(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    cancelled_at: list[float] = []

    def cancelled() -> bool:
        if any(e["event"] == "progress" and e["steps"] for e in events):
            cancelled_at.append(time.monotonic())
        return bool(cancelled_at)

    outcome = retrain(job(tmp_path, budget_steps=10**6), events.append, cancelled)
    assert outcome.cancelled and time.monotonic() - cancelled_at[0] < 1.0
    assert list((tmp_path / "runs").glob("retrain-balance-*/checkpoint.safetensors"))
    assert "balance-1" not in policy_paths(tmp_path)


@SUBPROCESS
def test_a_training_whose_process_is_killed_goes_on_in_another_one(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    processes: list[TrainingProcess] = []

    def begun() -> TrainingProcess:
        processes.append(TrainingProcess())
        return processes[-1]

    def heard(event: dict[str, Any]) -> None:
        events.append(event)
        if len(processes) == 1 and event["event"] == "progress" and event["steps"]:
            os.kill(processes[0].pid, signal.SIGKILL)

    outcome = retrain(job(tmp_path), heard, process=begun)
    assert len(processes) == 2 and not outcome.cancelled
    assert [e["event"] for e in events if e["event"] in ("restarted", "comparison")] == ["restarted", "comparison"]


def test_a_policy_id_stands_for_a_name_only_as_long_as_the_name_holds_it(tmp_path: Path) -> None:
    assert reference_of("gait:tripod", tmp_path) == "gait:tripod"
    with pytest.raises(PolicyNotFound, match="not in the store"):
        reference_of("balance@00000000", tmp_path)


def test_only_a_policy_for_the_task_is_a_rival(tmp_path: Path) -> None:
    for rival in ("balance", "gait:stand"):
        assert rival_for("balance", rival, tmp_path) == rival
    assert rival_for("balance", "forward", tmp_path) == "balance"
    with pytest.raises(TrainingError, match="task of policy forward"):
        plan(dataclasses.replace(job(tmp_path), current="forward"))


def test_a_policy_of_a_file_is_kept_in_the_store_once_and_found_by_its_id(tmp_path: Path) -> None:
    shipped, store = find_policy("balance"), tmp_path / "store"
    assert isinstance(shipped, Policy)
    changed = dataclasses.replace(shipped.mlp, weights=tuple(w / 2 for w in shipped.mlp.weights))
    policy = save_policy(tmp_path / "mine", changed, shipped.card)
    for _ in range(2):
        keep_policy(policy, store)
    (store / "policies" / "broken.safetensors").write_bytes(b"rubbish")
    assert reference_of(policy.policy_id, store) == "balance-1"
    assert find_policy("balance-1", store).policy_id == policy.policy_id
    keep_policy(shipped, store)
    assert sorted(p.stem for p in (store / "policies").glob("*.json")) == ["balance-1"], "what is shipped is there"


def test_a_policy_that_two_keep_at_once_is_there_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both find that it is not there yet."""
    shipped, asked = find_policy("balance"), threading.Barrier(2)
    assert isinstance(shipped, Policy)
    changed = dataclasses.replace(shipped.mlp, weights=tuple(w / 2 for w in shipped.mlp.weights))
    policy = save_policy(tmp_path / "mine", changed, shipped.card)

    @contextlib.contextmanager
    def both(folder: Path) -> Iterator[None]:
        asked.wait(10.0)
        with locked(folder):
            yield

    monkeypatch.setattr(artefact, "locked", both)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: keep_policy(policy, tmp_path), range(2)))
    assert [p.stem for p in (tmp_path / "policies").glob("*.json")] == ["balance-1"]


@pytest.mark.parametrize(
    ("budget_s", "evaluations", "pairs"), [(0.0, 48, 64), (3.0, 16, 32), (10.0, 24, 40), (60.0, 48, 64)]
)
def test_a_short_budget_is_not_spent_on_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, budget_s: float, evaluations: int, pairs: int
) -> None:
    monkeypatch.setattr(retraining, "preset", lambda *_: dataclasses.replace(TINY, evaluations=48))
    run = plan(job(tmp_path, budget_s=budget_s))
    assert (run.config.evaluations, run.pairs) == (evaluations, pairs)
