"""Statistics that are compared sample by sample, and motions that are foreseen by regression."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import binom
from tcbi_cases import BENCH_TRUTH, bench_rollouts, hexapod_rollouts

from tcbi_infer.errors import InferError
from tcbi_infer.statistics import library
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.expansion import Expansion, expansion, nearest
from tcbi_infer.tcbi.in_time import SKETCH, _sketched, comparable, differences, no_differences
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.proposal import from_probit
from tcbi_sim.model import base_model

TRUTH, SD = np.array([0.4, -0.3]), np.array([0.2, 0.05])


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem.of(*bench_rollouts(), timestep=0.005)


def motions(z: np.ndarray, bend: float, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(N, 30) motions that bend with the parameters, and their (N,) squares; zero at `TRUTH`."""
    rng = np.random.default_rng(7)
    slope, curve = rng.standard_normal((2, 2, 30))
    off = (z - TRUTH) / SD
    found = off @ slope + bend * off**2 @ curve
    found += noise * np.random.default_rng(seed).standard_normal(found.shape)
    return found, (found**2).sum(axis=1)


def regressed(z: np.ndarray, energy: np.ndarray, motion: np.ndarray) -> Expansion:
    near = nearest(energy, z.shape[1])
    assert near is not None
    return expansion(z[near], motion[near])


def test_the_divergence_is_the_mean_square_over_the_variance_and_zero_for_equals(problem: Problem) -> None:
    statistics, groups = [library()["joint_motion"]], [g.arrays for g in problem.groups]
    kept, real, _ = comparable(statistics, groups, [True], 2)
    assert [s.name for s in kept] == ["joint_motion"] and real.means.shape == (16, 1)
    assert real.divergences(differences(kept, groups, groups, [True], 2)) == pytest.approx(0.0)
    mean = [
        dataclasses.replace(g, joint_position=np.full_like(g.joint_position, g.joint_position.mean())) for g in groups
    ]
    assert real.divergences(differences(kept, groups, mean, [True], 2)) == pytest.approx(1.0)


def test_resamples_pool_their_units_and_units_that_nothing_is_compared_in_change_nothing(problem: Problem) -> None:
    statistics, (group,) = [library()["joint_motion"]], [g.arrays for g in problem.groups]
    moved = dataclasses.replace(
        group, joint_position=group.joint_position + np.linspace(0, 0.1, 8)[None, :, None, None]
    )
    kept, real, _ = comparable(statistics, [group, group], [True, False], 1)
    found = differences(kept, [group, group], [moved, moved], [True, False], 1)
    assert np.all(real.means[8:] == 0) and np.all(found.sums[:, 8:] == 0) and np.all(found.sketch[:, 8:] == 0)
    first = np.eye(16)[[1, 7]]
    expected = np.linspace(0, 0.1, 8)[[1, 7]] ** 2 / real.variance
    assert real.divergences(found, first)[0, :, 0] == pytest.approx(expected, rel=1e-4)


def test_a_sketch_keeps_inner_products_about() -> None:
    """Of four times as many values as it has places; of as many as it has, or fewer, exactly."""
    values = np.random.default_rng(0).standard_normal((4, 3, 8, SKETCH // 2))
    values[1] += values[0]
    long, exact = _sketched(values, 1), np.einsum("nsck,msck->snm", values, values)
    found = np.einsum("nsd,msd->snm", long, long)
    assert long.shape == (4, 3, SKETCH)
    assert 0 < np.abs(found - exact).max() < 0.35 * exact.max()
    few = values[..., : SKETCH // 8]
    short, exact = _sketched(few, 1), np.einsum("nsck,msck->snm", few, few)
    assert np.einsum("nsd,msd->snm", short, short) == pytest.approx(exact)


def test_motions_that_are_foreseen_without_an_error_change_no_energy(problem: Problem) -> None:
    """Sketches of noise are not quite as long as the noise; what all particles share of that must cancel."""
    statistics, (group,) = [library()["joint_motion"]], [g.arrays for g in problem.groups]
    noise = 0.1 * np.random.default_rng(0).standard_normal(group.joint_position.shape)
    z = np.random.default_rng(1).standard_normal((20, 1))
    moved = dataclasses.replace(
        group, joint_position=group.joint_position + noise + 0.1 * z[:, :, None, None] * np.sin(9 * group.time)[:, None]
    )
    kept, real, _ = comparable(statistics, [group], [True], 1)
    found, floor = differences(kept, [group], [moved], [True], 1), np.ones(1)
    moves = expansion(z, real.motion(found, floor))
    assert moves.order == 1 or np.abs(moves.coefficients[2]).max() < 1e-6
    assert real.foreseen(found, floor, moves, z).sums == pytest.approx(found.sums, rel=1e-3)


def test_what_is_the_same_throughout_a_rollout_counts_by_few_means(problem: Problem) -> None:
    statistics, (group,) = [library()["joint_motion"]], [g.arrays for g in problem.groups]
    kept, real, _ = comparable(statistics, [group], [True], 1)
    white = 0.1 * np.random.default_rng(0).standard_normal(group.joint_position.shape)
    free = {}
    for name, apart in (("white", white), ("off", np.full_like(white, 0.1))):
        moved = dataclasses.replace(group, joint_position=group.joint_position + apart)
        free[name] = real.noise(differences(kept, [group], [moved], [True], 1), 0)[1][0] / real.means.sum()
    assert free["white"] > 0.7 and free["off"] < 0.02


def test_what_may_be_the_same_in_all_stretches_counts_by_the_root_of_them(problem: Problem) -> None:
    """The last of them is a rollout of at least 2 s: twice as long ones are not twice as sure."""
    statistics, (group,) = [library()["joint_motion"]], [g.arrays for g in problem.groups]
    drift = np.repeat(np.random.default_rng(0).standard_normal(group.joint_position.shape)[:, :, ::20], 20, axis=2)
    moved = dataclasses.replace(group, joint_position=group.joint_position + drift[:, :, : len(group.time)])
    freedom = {}
    for seconds in (1.5, 3.0):
        half = slice(0, round(seconds / 3.0 * len(group.time)))
        parts = [
            dataclasses.replace(g, time=g.time[half], joint_position=g.joint_position[:, :, half])
            for g in (group, moved)
        ]
        _, real, _ = comparable(statistics, [parts[0]], [True], 1)
        assert real.stretches == pytest.approx(8 * max(1.0, np.ptp(parts[0].time) / 2.0))
        freedom[seconds] = real.noise(differences(statistics, [parts[0]], [parts[1]], [True], 1), 0)[1][0]
    assert 1.3 < freedom[3.0] / freedom[1.5] < 1.9


def test_a_statistic_without_a_sample_at_each_time_cannot_be_compared_in_time(problem: Problem) -> None:
    sparse = dataclasses.replace(library()["early_response"], in_time=True)
    with pytest.raises(InferError, match=r"early_response is compared in time, so .* at each of \d+ times"):
        comparable([sparse], [g.arrays for g in problem.groups], [True], 1)


def test_where_a_policy_acts_nothing_is_compared_in_time() -> None:
    walking = hexapod_rollouts("balance", "gait:tripod")
    acting = Problem.of(base_model("hexapod"), walking, loop="acting", timestep=0.01)
    replayed = Problem.of(base_model("hexapod"), walking, loop="open", timestep=0.01)
    only = Problem.of(base_model("hexapod"), hexapod_rollouts("balance"), loop="acting", timestep=0.01)
    assert {"joint_motion", "body_motion"} <= set(acting.observed.statistics)
    assert np.sum(acting.observed.in_time.means > 0) == np.sum(replayed.observed.in_time.means > 0) / 2
    assert not {"joint_motion", "body_motion"} & set(only.observed.statistics)
    assert only.simulate(np.full((2, 3), 0.5)).differences.sums.shape == no_differences(2).sums.shape


@pytest.mark.parametrize(("bend", "order"), [(0.0, 1), (0.15, 2)])
def test_motions_say_where_they_vanish_from_particles_far_away(bend: float, order: int) -> None:
    z = TRUTH + 4 * SD + 3 * SD * np.random.default_rng(2).standard_normal((60, 2))
    found, energy = motions(z, bend, 0.1)
    moves = regressed(z, energy, found)
    assert moves.order >= order
    grid = TRUTH + SD * np.stack(np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-3, 3, 61)), -1).reshape(-1, 2)
    assert np.all(np.abs(grid[np.argmin(moves.energy(grid))] - TRUTH) < (0.3 if bend == 0 else 1.0) * SD)


def test_what_is_thrown_at_random_into_each_motion_is_not_foreseen_but_doubted() -> None:
    z = TRUTH + SD * np.random.default_rng(2).standard_normal((100, 2))
    (calm, energy), (rough, energies) = motions(z, 0.0, 0.1), motions(z, 0.0, 1.0)
    smooth, rougher = regressed(z, energy, calm), regressed(z, energies, rough)
    exact = motions(z, 0.0, 0.0)[1]
    assert np.std(rougher.energy(z) - exact) < 0.7 * np.std(energies - exact)
    assert rougher.missed.sum() == pytest.approx(30.0, rel=0.5) and smooth.missed.sum() < 1.0


def test_a_statistic_with_a_distribution_is_asked_for_beside_those_in_time() -> None:
    with pytest.raises(InferError, match="joint_motion: compared in time alone"):
        Problem.of(*bench_rollouts(count=3), statistics=("joint_motion",), timestep=0.01)


def test_few_particles_are_no_ground_for_an_expansion() -> None:
    z = np.random.default_rng(0).standard_normal((5, 2))
    assert nearest(motions(z, 0.0, 0.0)[1], 2) is None
    assert nearest(np.r_[np.ones(5), np.full(40, np.inf)], 2) is None


@pytest.mark.parametrize("cube", [True, False])
def test_motions_are_expanded_where_they_bend_least(cube: bool) -> None:
    """A truth near the prior's bound: over the cube or in probit space, wherever the motions are linear."""
    z = np.random.default_rng(3).standard_normal((40, 2))
    z[:, 0] += 1.0  # towards a bound at 2.3
    place = from_probit if cube else np.asarray
    rng = np.random.default_rng(4)
    motion = (place(z) - place(np.array([2.3, 0.0]))) @ rng.standard_normal((2, 30)) + 0.01 * rng.standard_normal(
        (40, 30)
    )
    found = expansion(z, motion)
    assert found.cube is cube
    assert found.motion(np.array([[2.3, 0.0]])) == pytest.approx(np.zeros((1, 30)), abs=0.02)


def test_of_noisy_readings_motions_in_time_tell_more_than_their_distributions() -> None:
    """Damping of a servo bench whose readings have 40 times the rig's noise."""
    model, quiet = bench_rollouts()
    rng, found = np.random.default_rng(1), {}
    noisy = [
        dataclasses.replace(m, joint_position=m.joint_position + 0.08 * rng.standard_normal(m.joint_position.shape))
        for m in quiet
    ]
    for statistics in (("joint_tracking", "early_response"), ("joint_tracking", "early_response", "joint_motion")):
        problem = Problem.of(model, noisy, statistics=statistics, timestep=0.005)
        result = infer(problem, seed=0, particles=40, generations=6)  # with 4 the widths of some seeds are chance
        weights = np.exp(result.log_weights)
        mean = weights @ result.unit
        found[statistics[-1]] = mean - BENCH_TRUTH, np.sqrt(weights @ (result.unit - mean) ** 2)
    (_, without), (error, sd) = found["early_response"], found["joint_motion"]
    assert sd[1] < 0.6 * without[1] and np.all(np.abs(error) < 3 * sd)


def test_intervals_of_a_dozen_servo_benches_hold_their_truths_and_none_is_called_wrong() -> None:
    """Truths drawn from the prior, simulated in other time steps: as many as of exact intervals; 0.1 % fail."""
    held, gains = [], []
    for seed in range(12):
        truth = np.random.default_rng([seed, 3]).random(3)
        model, measurements = bench_rollouts(tuple(truth), count=6, seed=seed, duration=2.0, timestep=0.002)
        found = infer(Problem.of(model, measurements), seed=seed, particles=20, generations=3)
        pairs = zip(found.estimates, model.from_unit(truth), strict=True)
        held += [e.low90 <= value <= e.high90 for e, value in pairs]
        gains.append(found.estimates[0].variance_ratio)
        assert found.fits is not False
    assert sum(held) >= binom.ppf(0.001, len(held), 0.9)
    assert np.median(gains) < 0.1, "and they are narrow where the data tell"
