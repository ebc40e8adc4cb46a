"""Training: the deployed network is the trained one, a killed run goes on to the same result, gaits can be copied."""

import dataclasses
import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from training_cases import MODEL, TINY, Killed, train

from tcbi_contract.names import CONTROL_RATE_HZ
from tcbi_policy import imitation
from tcbi_policy import training as training_module
from tcbi_policy.artefact import load_policy
from tcbi_policy.configuration import PRESETS, TrainingConfig, preset
from tcbi_policy.errors import TrainingError
from tcbi_policy.gaits import CYCLES
from tcbi_policy.imitation import next_posture
from tcbi_policy.runs import Run
from tcbi_policy.stable_baselines import OBSERVATION_SCALE
from tcbi_policy.training import Training
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.tasks import find_task


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_what_is_deployed_acts_as_what_was_trained(tmp_path: Path, algorithm: str) -> None:
    config = dataclasses.replace(TINY, algorithm=algorithm, steps=160, updates=1)
    training = Training(tmp_path, config, MODEL)
    training.run()
    observation = np.random.default_rng(0).normal(0, 0.3, (50, 21))
    scaled = (observation * OBSERVATION_SCALE).astype(np.float32)
    action, _ = training.algorithm.predict(scaled, deterministic=True)
    expected = training.environment.limit * (np.tanh(action) if algorithm == "ppo" else action)
    np.testing.assert_allclose(training.present()(observation), expected, atol=1e-6)


@pytest.mark.parametrize(
    "config",
    [
        TINY,
        dataclasses.replace(TINY, steps=800, epochs=6, observation_noise=0.02, effects=("command_latency",)),
        dataclasses.replace(TINY, algorithm="sac", updates=2, batch_size=16),
    ],
    ids=["ppo", "ppo, randomised", "sac"],
)
def test_a_killed_run_goes_on_to_the_same_weights(tmp_path: Path, config: TrainingConfig) -> None:
    whole = train(tmp_path / "whole", config)
    with pytest.raises(Killed):
        train(tmp_path / "killed", config, die_after=3)
    resumed = train(tmp_path / "killed", config)
    assert resumed.card.sha256 == whole.card.sha256
    assert [p["steps"] for p in resumed.card.curve] == [p["steps"] for p in whole.card.curve]


def test_sac_killed_between_its_two_files_goes_on_to_the_same_weights(tmp_path: Path, monkeypatch) -> None:
    config = dataclasses.replace(TINY, algorithm="sac", updates=2, batch_size=16)
    whole = train(tmp_path / "whole", config)
    write, checkpoints = training_module.replace_file, []

    def killed_at_the_third(path: Path, data: bytes) -> None:
        checkpoints.extend([path] if path.name == "checkpoint.safetensors" else [])
        if len(checkpoints) == 3:
            raise Killed
        write(path, data)

    monkeypatch.setattr(training_module, "replace_file", killed_at_the_third)
    with pytest.raises(Killed):
        train(tmp_path / "killed", config)
    assert len(list((tmp_path / "killed").glob("replay-*.npz"))) == 2
    monkeypatch.setattr(training_module, "replace_file", write)
    assert train(tmp_path / "killed", config).card.sha256 == whole.card.sha256
    (left,) = (tmp_path / "killed").glob("replay-*.npz")
    left.unlink()
    with pytest.raises(TrainingError, match=rf"{left.name} belongs to it and is not there"):
        Training(tmp_path / "killed", config, MODEL).run()


def progress_events(folder: Path, config: TrainingConfig, moments: list[tuple[float, int]]) -> list[dict[str, Any]]:
    """What a run tells at moments (elapsed s, steps)."""
    told: list[dict[str, Any]] = []
    training = Training(folder, config, MODEL, report=told.append)
    for training.state.elapsed, training.state.steps in moments:
        training.progress()
    return told


def test_the_remaining_time_leaves_out_the_start_up_and_is_unknown_before_the_first_set(tmp_path: Path) -> None:
    told = progress_events(tmp_path, TINY, [(100.0, 0), (110.0, 120)])
    assert [event["remaining_s"] for event in told] == [None, pytest.approx(30.0)]
    assert [event["share"] for event in told] == [0.0, 0.25]


def test_a_budget_bounds_the_remaining_time(tmp_path: Path) -> None:
    told = progress_events(tmp_path, dataclasses.replace(TINY, budget_s=20.0), [(5.0, 0), (15.0, 12)])
    assert [event["remaining_s"] for event in told] == [pytest.approx(15.0), pytest.approx(5.0)]
    assert told[-1]["share"] == 0.75


def test_training_changes_the_policy_and_the_card_tells_how(tmp_path: Path) -> None:
    policy = load_policy(train(tmp_path).path or Path())
    card = policy.card
    assert (card.task, card.model, card.training["seed"], card.training["algorithm"]) == (
        "balance",
        "hexapod-v0",
        0,
        "ppo",
    )
    assert card.training["steps_taken"] == 480
    assert set(card.posterior) == {"friction", "mass", "gain"} and card.posterior["mass"]["unit"] == "kg"
    assert card.libraries["mujoco"].startswith("4.")
    assert card.curve[0]["steps"] == 0 and card.curve[-1]["steps"] == 480


def test_the_card_tells_the_weighted_mean_and_spread_of_the_posterior(tmp_path: Path) -> None:
    weights = np.array([0.7, 0.2, 0.1])
    model = MODEL.with_particles(MODEL.particles[:3], np.log(weights))
    told = Training(tmp_path, TINY, model)._artefact().card.posterior
    for name, column in zip(model.names, model.particles.T, strict=True):
        assert told[name]["mean"] == pytest.approx(weights @ column)
        assert told[name]["sd"] == pytest.approx(np.sqrt(np.average((column - weights @ column) ** 2, weights=weights)))


def test_a_training_is_known_by_what_its_model_holds(tmp_path: Path) -> None:
    others = MODEL.with_particles(MODEL.particles[::-1]), dataclasses.replace(MODEL, joint_gains=(1.01,) * 18)
    assert len({Run.of(TINY, model, tmp_path).contents for model in (MODEL, *others)}) == 3


def test_the_best_moment_is_never_one_at_which_more_simulations_diverge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moments = [(3, 10.0), (1, 20.0), (2, 9000.0), (1, 30.0), (1, 25.0), (0, 5.0), (0, math.nan)]
    training = Training(tmp_path, TINY, MODEL)
    for steps, (diverged, mean_return) in enumerate(moments):
        summary = {"mean_return": mean_return, "diverged": diverged}
        evaluation = SimpleNamespace(summary=lambda summary=summary: summary)
        monkeypatch.setattr(training_module, "evaluate", lambda *_, evaluation=evaluation: evaluation)
        training.state.steps = steps
        training._evaluate()
        best = [(3, 10.0), (1, 20.0), (1, 20.0), (1, 30.0), (1, 30.0), (0, 5.0), (0, 5.0)][steps]
        assert (training.state.best_diverged, training.state.best) == best


def test_a_policy_under_which_everything_diverges_has_a_card_in_plain_json(tmp_path: Path) -> None:
    training = Training(tmp_path, TINY, MODEL)
    training.state.best = math.nan
    training.state.curve.append({"steps": 0, "mean_return": math.nan})
    card = (training._artefact().path or Path()).with_suffix(".json").read_text()
    assert "NaN" not in card and load_policy(tmp_path / "policy.safetensors").card.curve[0]["mean_return"] is None


def test_a_start_policy_is_where_training_starts(tmp_path: Path) -> None:
    first = train(tmp_path / "first")
    second = Training(tmp_path, TINY, MODEL, start=first)
    observation = np.random.default_rng(0).normal(0, 0.3, (20, 21))
    np.testing.assert_allclose(second.present()(observation), first.mlp(observation), atol=1e-6)


@pytest.mark.parametrize(("sets", "frozen"), [(12, 2), (4, 1), (3, 0)])
def test_a_warm_up_leaves_the_policy_as_it_is_for_a_quarter_of_the_sets_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sets: int, frozen: int
) -> None:
    training = Training(tmp_path, dataclasses.replace(TINY, steps=160 * sets, warm_up=2), MODEL)
    seen, between = [training.present().weights[0]], training.next_set

    def next_set() -> None:
        seen.append(training.present().weights[0])
        between()

    monkeypatch.setattr(training, "next_set", next_set)
    training.run()
    changes = [not np.array_equal(a, b) for a, b in itertools.pairwise(seen)]
    assert changes.index(True) == frozen + 1


def test_a_budget_in_seconds_ends_the_run(tmp_path: Path) -> None:
    policy = train(tmp_path, dataclasses.replace(TINY, steps=10**9, budget_s=0.5))
    assert policy.card.training["steps_taken"] < 10**6


def test_a_run_without_a_limit_in_steps_tells_its_share_of_the_time_and_warms_up_as_it_is_told(tmp_path: Path) -> None:
    config = dataclasses.replace(TINY, steps=0, budget_s=20.0, warm_up=2)
    told = progress_events(tmp_path, config, [(5.0, 0), (15.0, 160)])
    assert [(e["share"], e["total_steps"]) for e in told] == [(0.25, 0), (0.75, 0)]
    assert [e["remaining_s"] for e in told] == [pytest.approx(15.0), pytest.approx(5.0)]
    assert Training(tmp_path, config, MODEL).warm_up == 2


def test_a_run_without_a_limit_in_steps_ends_with_its_time(tmp_path: Path) -> None:
    policy = train(tmp_path, dataclasses.replace(TINY, steps=0, budget_s=0.5))
    assert policy.card.training["steps_taken"] < 10**6


def test_sac_ends_between_two_sets_when_its_time_is_over_in_mid_set(tmp_path: Path) -> None:
    config = dataclasses.replace(TINY, algorithm="sac", updates=1, batch_size=8, steps=10**6, budget_s=1e6)
    training = Training(tmp_path, config, MODEL)
    step, taken = training.environment.step, []

    def counted(action: np.ndarray) -> Any:
        taken.append(action)
        if len(taken) == 50:
            training.state.elapsed = 2e6
        return step(action)

    training.environment.step = counted  # type: ignore[method-assign]
    training.run()
    buffer: Any = training.algorithm.replay_buffer  # type: ignore[attr-defined]
    assert training.state.steps == 2 * 160 and buffer.size() == 2 * 40
    with np.load(tmp_path / "replay-320.npz") as file:
        assert file["pos"][0] == 2 * 40


def test_sac_takes_whole_sets_of_steps(tmp_path: Path) -> None:
    config = dataclasses.replace(TINY, algorithm="sac", updates=1, batch_size=8, steps=200)
    training = Training(tmp_path, config, MODEL)
    training.run()
    buffer: Any = training.algorithm.replay_buffer  # type: ignore[attr-defined]
    assert training.state.steps == 2 * 160 and buffer.size() == 2 * 40


def test_sac_goes_on_with_what_it_remembers(tmp_path: Path) -> None:
    config = dataclasses.replace(TINY, algorithm="sac", updates=1, batch_size=8)
    with pytest.raises(Killed):
        train(tmp_path, config, die_after=3)
    training = Training(tmp_path, config, MODEL)
    training.run()
    buffer: Any = training.algorithm.replay_buffer  # type: ignore[attr-defined]
    assert buffer.size() == 480 // 4


def test_the_posture_after_the_nearest_one_is_what_a_gait_teaches() -> None:
    cycle = CYCLES["tripod"]
    noisy = cycle + np.random.default_rng(0).normal(0, 0.02, cycle.shape)
    np.testing.assert_array_equal(next_posture(cycle, noisy), np.roll(cycle, -1, axis=0))


def test_a_policy_that_copied_the_tripod_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imitation, "UPDATES", 250)
    config = dataclasses.replace(TINY, task="forward", steps=1, imitate="tripod", imitate_rounds=2, evaluations=4)
    training = Training(tmp_path, dataclasses.replace(config, warm_up=1), MODEL)
    training.run()
    assert training.state.curve[0]["distance_m"] > 0.05  # standing moves it by less than 0.01


def test_a_budget_ends_the_copying_of_a_gait_too_which_says_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imitation, "UPDATES", 100)
    events: list[dict[str, Any]] = []

    def told(event: dict[str, Any]) -> None:
        events.append(event)
        if sum(e["event"] == "imitation" for e in events) == 2:
            training.state.elapsed = 1e6

    config = dataclasses.replace(TINY, imitate="tripod", imitate_rounds=1000, budget_s=5e5)
    training = Training(tmp_path, config, MODEL, report=told)
    training.run()
    assert [e["event"] for e in events] == [*["imitation", "progress"] * 2, "evaluation", "progress", "done"]
    assert 0.0 < events[1]["share"] < 1.0 and 0.0 < events[1]["remaining_s"] < 5e5 and events[3]["remaining_s"] == 0.0
    assert training.state.steps == 0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"algorithm": "dqn"}, "ppo or sac"),
        ({"steps": 0}, "steps: got 0, allowed is more than 0, or 0 where budget_s is more than 0"),
        ({"steps": -1, "budget_s": 5.0}, "steps: got -1"),
        ({"gamma": 1.0}, "gamma"),
        ({"budget_s": -1.0}, "budget_s"),
        ({"seed": 2**32}, "seed: got 4294967296, allowed is 0 to 4294967295"),
    ],
)
def test_a_senseless_configuration_is_refused_by_name(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(TrainingError, match=says):
        dataclasses.replace(TINY, **changes).checked()


def test_presets_exist_for_both_tasks_and_the_papers_settings_are_the_papers() -> None:
    assert {task for p in PRESETS.values() for task in p} == {"balance", "forward"}
    paper = preset("paper", "forward")
    settings = (
        paper.algorithm,
        paper.steps,
        paper.learning_rate,
        paper.batch_size,
        paper.gamma,
        paper.tau,
        paper.layers,
    )
    assert settings == ("sac", 5_001_600, 1e-3, 256, 0.99, 0.005, (256, 256))
    for task in ("balance", "forward"):
        config, ticks = preset("paper", task), round(find_task(task).duration * CONTROL_RATE_HZ)
        assert config.steps % (config.environments * ticks) == 0, "whole sets of episodes"
    assert paper.updates == paper.environments  # one update for each step
    with pytest.raises(UnknownNameError, match="fast, paper"):
        preset("quick", "balance")
