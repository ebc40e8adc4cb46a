"""Where histograms agree and motions do not, the model is called wrong."""

import dataclasses

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts, hexapod_rollouts

from tcbi_infer.tcbi import driver, problem
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.predictive import CLOSE_DRAWS, DEPARTED, DRAWS, JOINTS, TILTS, departures
from tcbi_infer.tcbi.problem import Problem
from tcbi_sim.model import base_model

BENCH = base_model("servo_bench")
TORQUE = {"effects": ("torque_saturation",), "unit": (*BENCH_TRUTH, 0.2)}


def around(unit: tuple[float, ...], spread: float, count: int = 48) -> np.ndarray:
    """(count, P) particles around one, in the unit cube."""
    return np.clip(np.random.default_rng(0).normal(unit, spread, (count, len(unit))), 0.0, 1.0)


@pytest.mark.parametrize("spread", [0.02, 0.1])
def test_a_motion_like_the_draws_is_missed_as_they_are_and_a_late_one_by_more(spread: float) -> None:
    draws, equal = around(BENCH_TRUTH, spread), np.zeros(48)
    nothing = [Problem.of(BENCH, bench_rollouts(seed=seed)[1]) for seed in range(3)]
    assert np.median([departures(p, draws, equal).signals[JOINTS].missed for p in nothing]) < 1.5
    late = bench_rollouts((*BENCH_TRUTH, 0.6), effects=("command_latency",))[1]
    assert departures(Problem.of(BENCH, late), draws, equal).signals[JOINTS].missed > DEPARTED[JOINTS]


def test_a_robot_with_an_attitude_is_followed_in_it_too_and_few_draws_say_nothing() -> None:
    robot = Problem.of(base_model("hexapod"), hexapod_rollouts("balance"), timestep=0.01)
    draws = around((0.5, 0.5, 0.5), 0.1, count=12)
    assert set(departures(robot, draws, np.zeros(12)).signals) == {JOINTS, TILTS}
    assert departures(robot, draws, np.r_[0.0, np.full(11, -40.0)]) == ({}, 1, (), ())


def test_a_wide_posterior_is_looked_through_until_what_is_missed_falls_no_further() -> None:
    """Draws of the prior: the first look about the best mixture misses by more than a right model's predictions may."""
    rng = np.random.default_rng(1)
    for seed in range(3):
        robot = Problem.of(BENCH, bench_rollouts(seed=seed)[1])
        told = departures(robot, rng.random((48, 3)), np.zeros(48))
        assert not told.far and np.abs(np.array(told.nearest) - BENCH_TRUTH).max() < 0.2
        late = bench_rollouts((*BENCH_TRUTH, 0.6), effects=("command_latency",), seed=seed)[1]
        told = departures(Problem.of(BENCH, late), rng.random((48, 3)), np.zeros(48))
        assert told.far and told.particles > 48 + CLOSE_DRAWS * 3, "it looked again"


def test_it_takes_no_more_memory_than_a_generation_and_says_the_same_in_parts(monkeypatch) -> None:
    draws, whole = around(BENCH_TRUTH, 0.1), Problem.of(BENCH, bench_rollouts()[1])
    told, asked = departures(whole, draws, np.zeros(48)), []
    simulated = Problem._simulated
    monkeypatch.setattr(Problem, "_simulated", lambda self, unit: asked.append(len(unit)) or simulated(self, unit))
    monkeypatch.setattr(problem, "CHUNK_VALUES", 1e5)
    assert departures(whole, draws, np.zeros(48)) == told
    assert sum(asked) == told.particles == 48 + CLOSE_DRAWS * len(BENCH_TRUTH) and max(asked) < 10


def test_ctrl_c_while_it_replays_stops_as_at_any_time(tmp_path, monkeypatch) -> None:
    def pressed(*args: object) -> None:
        raise KeyboardInterrupt

    rollouts = bench_rollouts()[1]
    monkeypatch.setattr(driver, "departures", pressed)
    with pytest.raises(driver.Interrupted, match="the same command goes on"):
        infer(Problem.of(BENCH, rollouts, timestep=0.01), folder=tmp_path, particles=20, generations=2)
    monkeypatch.undo()
    assert infer(Problem.of(BENCH, rollouts, timestep=0.01), folder=tmp_path, particles=20, generations=2).estimates


@pytest.mark.parametrize("seed", [1, 2])
def test_a_torque_limit_that_looks_like_a_soft_servo_is_no_fit_and_its_gain_is_not_told(seed: int) -> None:
    """By its histograms the model fits, with a gain far below the true one."""
    found = infer(Problem.of(BENCH, bench_rollouts(seed=seed, duration=4.0, **TORQUE)[1]), seed=0)
    assert found.fits is False and not any(e.identified for e in found.estimates)
    assert any("no parameters reproduce joint positions in time" in line for line in found.warnings)


@pytest.mark.parametrize("spoilt", [None, 5])
def test_a_rollout_whose_joint_stood_still_is_named_and_no_other(spoilt: int | None) -> None:
    rollouts = bench_rollouts()[1]
    if spoilt is not None:
        still = np.broadcast_to(rollouts[spoilt].joint_position[:1], rollouts[spoilt].joint_position.shape)
        rollouts[spoilt] = dataclasses.replace(rollouts[spoilt], joint_position=still)
    told = infer(Problem.of(BENCH, rollouts, timestep=0.01), particles=20, generations=2).warnings
    named = [line.split()[0] for line in told if "unlike the other rollouts" in line]
    assert named == ([] if spoilt is None else [rollouts[spoilt].rollout_id])


@pytest.mark.parametrize("seed", [0, 1])
def test_without_it_the_model_fits_and_tells_the_gain(seed: int) -> None:
    found = infer(Problem.of(BENCH, bench_rollouts(seed=seed)[1]), seed=0)
    assert found.fits is True and found.estimates[0].identified


@pytest.mark.parametrize("method", ["calibrated", "paper"])
def test_who_watches_is_told_when_generations_are_over_and_predictions_are_checked(method: str) -> None:
    told: list[driver.Progress] = []
    infer(Problem.of(BENCH, bench_rollouts()[1], timestep=0.01), method, watch=told.append, particles=10, generations=2)
    assert [p.stage for p in told if p.stage] == ([driver.CHECKING] if method == "calibrated" else [])
    assert bool(told[-1].stage) == (method == "calibrated")


def test_the_estimate_counts_the_check_that_comes_after_the_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[driver.Progress] = []
    monkeypatch.setattr(driver.time, "monotonic", lambda: float(len(told)))
    infer(Problem.of(BENCH, bench_rollouts()[1], timestep=0.01), watch=told.append, particles=24, generations=2)
    check = (DRAWS + CLOSE_DRAWS * 3) / 24
    assert told[-1].stage == driver.CHECKING
    assert told[-1].remaining_s == pytest.approx((len(told) - 1) / 2 * check)
    (half,) = (i for i, p in enumerate(told) if (p.generation, p.share) == (2, 0.0))
    assert told[half].remaining_s == pytest.approx(half * (1 + check))
