"""What shorter time steps do to motions is measured on a few particles, and allowed for in all."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer.tcbi import calibrated, finer
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.expansion import expansion
from tcbi_infer.tcbi.features import Features
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import FINE_STEP, Problem
from tcbi_infer.tcbi.proposal import to_probit

BENT = 0.05  # rad, at most, that long steps move joints by


@pytest.fixture(scope="module")
def problem() -> Problem:
    model, rollouts = bench_rollouts()
    return Problem.of(model, rollouts, statistics=("joint_tracking", "joint_motion"))


def features(problem: Problem, unit: np.ndarray, bent: float = 0.0) -> Features:
    """Of simulations whose joints are moved by up to so much rad, as if that came of long steps."""

    def moved(problem: Problem, simulated: object) -> Features:
        arrays = [
            dataclasses.replace(a, joint_position=a.joint_position + bent * np.sin(7 * a.time)[:, None])
            for a in simulated.exact  # type: ignore[attr-defined]
        ]
        return find_method("calibrated").view(problem, simulated._replace(exact=arrays))  # type: ignore[attr-defined]

    return problem.simulate(unit, view=moved)


def searched(problem: Problem, long: Callable[[np.ndarray], Features], finely: bool) -> calibrated.CalibratedState:
    settings, state = calibrated.CalibratedSettings(60, 7), calibrated.init(3)
    while not calibrated.finished(state, settings):
        rng = np.random.default_rng(state.generation)
        state, _ = calibrated.step(rng, state, long, problem.observed, settings)
        if finely:
            state = calibrated.finely(rng, state, functools.partial(features, problem), problem.observed, settings)
    return state


def test_simulations_with_long_steps_become_those_with_short_ones(problem: Problem) -> None:
    rng = np.random.default_rng(0)
    unit = np.array(BENCH_TRUTH) + rng.uniform(-0.05, 0.05, (40, 3))
    long, short, in_time = features(problem, unit, BENT), features(problem, unit), problem.observed.in_time
    z = to_probit(unit)
    floor = np.ones(1)
    moves = expansion(z, in_time.motion(long.differences, floor))
    by = finer.correction(in_time, floor, moves, z[:6], short.differences.only(slice(6)))
    found = finer.corrected(long.differences, by)
    before, after, asked = (in_time.divergences(d)[:, 0] for d in (long.differences, found, short.differences))
    assert by.particles == 6 and 0 < by.doubt[0] < 0.05 * before.mean()
    assert np.abs(after - asked).mean() < 0.15 * np.abs(before - asked).mean()
    assert finer.corrected(long.differences, finer.none(in_time)) is long.differences


def test_a_bias_of_long_steps_does_not_bias_the_posterior(problem: Problem) -> None:
    miss, sd = {}, {}
    for finely in (False, True):
        state = searched(problem, lambda unit: features(problem, unit, BENT), finely)
        unit, log_weights = calibrated.posterior(state)
        weights = np.exp(log_weights - log_weights.max())
        mean = weights @ unit / weights.sum()
        miss[finely] = np.abs(mean - BENCH_TRUTH)
        sd[finely] = np.sqrt(weights @ (unit - mean) ** 2 / weights.sum())
    assert np.linalg.norm(miss[True]) < 0.5 * np.linalg.norm(miss[False])
    assert np.all(miss[True] < 3 * sd[True])


def test_it_is_done_once_before_the_last_generation_and_counted(problem: Problem, tmp_path: Path) -> None:
    result = infer(problem, seed=0, particles=20, generations=3, folder=tmp_path)
    assert problem.finer is not None and problem.finer.timestep == FINE_STEP < problem.timestep
    assert result.simulations >= (60 + finer.PARTICLES) * len(problem.rollout_ids)
    again = infer(problem, seed=0, particles=20, generations=3, folder=tmp_path)
    assert np.array_equal(result.log_weights, again.log_weights)


def test_steps_that_were_asked_for_and_single_generations_are_left_as_they_are(problem: Problem) -> None:
    for asked in (0.001, 0.01):
        chosen = Problem.of(*bench_rollouts(count=2), statistics=("joint_tracking",), timestep=asked)
        assert chosen.finer is None and chosen.timestep == asked
    settings, state = calibrated.CalibratedSettings(30, 1), calibrated.init(3)
    state, _ = calibrated.step(
        np.random.default_rng(0), state, functools.partial(features, problem), problem.observed, settings
    )
    assert calibrated.finely(np.random.default_rng(0), state, _never, problem.observed, settings) is state


def _never(unit: np.ndarray) -> Features:
    raise AssertionError("nothing is left to simulate for")
