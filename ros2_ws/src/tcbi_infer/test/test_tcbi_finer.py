"""What shorter time steps do to motions is measured on a few particles, and allowed for in all."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer.compare.timestep import USUAL_STEP
from tcbi_infer.tcbi import calibrated, checkpoint, finer
from tcbi_infer.tcbi.driver import CHECKING, FINER, Interrupted, Progress, infer
from tcbi_infer.tcbi.expansion import expansion
from tcbi_infer.tcbi.features import Features
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.proposal import to_probit
from tcbi_infer.tcbi.run_name import run_name

Simulate = Callable[[np.ndarray], Features]

SETTINGS = calibrated.CalibratedSettings(60, 7)
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


def searched(problem: Problem, long: Simulate, short: Simulate | None) -> calibrated.CalibratedState:
    state = calibrated.init(3)
    while not calibrated.finished(state, SETTINGS):
        rng = np.random.default_rng(state.generation)
        state, _ = calibrated.step(rng, state, long, problem.observed, SETTINGS)
        if short:
            state, _ = calibrated.finely(rng, state, short, problem.observed, SETTINGS)
    return state


def test_simulations_with_long_steps_become_those_with_short_ones(problem: Problem) -> None:
    rng = np.random.default_rng(0)
    unit = np.array(BENCH_TRUTH) + rng.uniform(-0.05, 0.05, (40, 3))
    long, short, in_time = features(problem, unit, BENT), features(problem, unit), problem.observed.in_time
    z, floor, six = to_probit(unit), np.ones(1), slice(6)
    moves = expansion(z, in_time.motion(long.differences, floor))
    by = finer.correction(in_time, floor, moves, z[six], long.differences.only(six), short.differences.only(six))
    found = finer.corrected(long.differences, by)
    before, after, asked = (in_time.divergences(d)[:, 0] for d in (long.differences, found, short.differences))
    assert by.particles == 6 and 0 < by.doubt[0] < 0.05 * before.mean()
    assert np.abs(after - asked).mean() < 0.15 * np.abs(before - asked).mean()
    same = finer.corrected(long.differences, finer.NONE)
    assert np.array_equal(same.sketch, long.differences.sketch) and np.array_equal(same.sums, long.differences.sums)


def test_what_scatters_less_is_taken_the_expansion_or_the_particles_own_motions(problem: Problem) -> None:
    """The same simulations as short ones: nothing is to be moved, however badly the expansion fits."""
    unit = np.random.default_rng(0).uniform(0.02, 0.98, (12, 3))
    long, in_time, z, six = features(problem, unit), problem.observed.in_time, to_probit(unit), slice(6)
    moves = expansion(z, in_time.motion(long.differences, np.ones(1)))
    own = long.differences.only(six)
    by = finer.correction(in_time, np.ones(1), moves, z[six], own, own)
    assert moves.missed.sum() > 0 and np.all(by.sketch == 0) and np.all(by.doubt == 0)


def test_a_bias_of_long_steps_does_not_bias_the_posterior(problem: Problem) -> None:
    miss, sd = {}, {}
    for short in (None, functools.partial(features, problem)):
        state = searched(problem, lambda unit: features(problem, unit, BENT), short)
        unit, log_weights = calibrated.posterior(state)
        weights = np.exp(log_weights - log_weights.max())
        mean = weights @ unit / weights.sum()
        miss[bool(short)] = np.abs(mean - BENCH_TRUTH)
        sd[bool(short)] = np.sqrt(weights @ (unit - mean) ** 2 / weights.sum())
    assert np.linalg.norm(miss[True]) < 0.5 * np.linalg.norm(miss[False])
    assert np.all(miss[True] < 3 * sd[True])


def test_a_search_that_would_have_ended_is_corrected_and_goes_on(problem: Problem) -> None:
    state = calibrated.init(3)
    rng, simulated = np.random.default_rng(0), functools.partial(features, problem)
    for _ in range(2):
        state, _ = calibrated.step(rng, state, simulated, problem.observed, SETTINGS)
    same, nothing = calibrated.finely(rng, state, _never, problem.observed, SETTINGS)
    assert same is state and nothing is None
    ended = state._replace(converged=True)
    corrected, info = calibrated.finely(rng, ended, simulated, problem.observed, SETTINGS)
    assert corrected.correction.particles == finer.PARTICLES and info is not None and info.alpha == corrected.alpha
    assert not corrected.converged and corrected.generation == ended.generation
    again = corrected._replace(converged=True)
    assert calibrated.finely(rng, again, _never, problem.observed, SETTINGS) == (again, None)


def test_a_divergence_that_is_not_finite_costs_that_particle_alone(problem: Problem) -> None:
    def spoilt(unit: np.ndarray) -> Features:
        found = features(problem, unit)
        found.divergence[0] = np.nan
        found.differences.sketch[0] = np.nan
        return found

    state, rng = calibrated.init(3), np.random.default_rng(0)
    state, _ = calibrated.step(rng, state, functools.partial(features, problem), problem.observed, SETTINGS)
    state, _ = calibrated.finely(rng, state._replace(converged=True), spoilt, problem.observed, SETTINGS)
    assert state.correction.particles == finer.PARTICLES - 1 and np.isfinite(state.alpha)


def test_it_is_done_once_before_the_last_generation_and_resumed(problem: Problem, tmp_path: Path) -> None:
    settings = {"seed": 0, "particles": 20, "generations": 3}
    assert problem.finer is not None and problem.finer.timestep == USUAL_STEP < problem.timestep
    told: list[Progress] = []
    through = infer(problem, folder=tmp_path / "through", watch=told.append, **settings)
    assert [(p.stage, p.generation, p.share) for p in told if p.stage] == [(FINER, 2, 1.0), (CHECKING, 3, 1.0)]
    with pytest.raises(Interrupted):
        infer(problem, folder=tmp_path / "killed", watch=_kill_in_the_last, **settings)
    (kept,) = (tmp_path / "killed").glob("*/state.npz")
    state = checkpoint.load(kept, calibrated.CalibratedState)
    assert state.generation == 2 and state.correction.particles == finer.PARTICLES
    resumed = infer(problem, folder=tmp_path / "killed", **settings)
    assert np.array_equal(resumed.log_weights, through.log_weights) and resumed.simulations == through.simulations


def test_steps_that_were_asked_for_and_single_generations_are_left_as_they_are(problem: Problem) -> None:
    for asked in (0.001, 0.01):
        chosen = Problem.of(*bench_rollouts(count=2), statistics=("joint_tracking",), timestep=asked)
        assert chosen.finer is None and chosen.timestep == asked
    by_itself = dataclasses.replace(problem, short_step=None)
    assert run_name(problem, "calibrated", SETTINGS, 0) != run_name(by_itself, "calibrated", SETTINGS, 0)
    rng, single = np.random.default_rng(0), SETTINGS._replace(generations=1)
    state, _ = calibrated.step(rng, calibrated.init(3), functools.partial(features, problem), problem.observed, single)
    assert calibrated.finely(rng, state, _never, problem.observed, single) == (state, None)


def _never(unit: np.ndarray) -> Features:
    raise AssertionError("nothing is left to simulate for")


def _kill_in_the_last(progress: Progress) -> None:
    if progress.generation == 3 and progress.share > 0:
        raise KeyboardInterrupt
