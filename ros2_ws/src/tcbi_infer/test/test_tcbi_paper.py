"""Algorithm 1: a step equals its literal loop; the posterior is the known one where there is one."""

import numpy as np
import pytest
from tcbi_cases import hexapod_rollouts, seen

from tcbi_infer.errors import InferError
from tcbi_infer.tcbi import paper
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.features import Features, Observed
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.weights import mean_and_variance, normalised
from tcbi_sim.model import base_model

CENTER, STEEPNESS = 0.6, 20.0


def quadratic(unit: np.ndarray) -> Features:
    """A divergence that is known exactly: exp(-alpha D) is then a normal of variance 1 / (2 alpha STEEPNESS)."""
    divergence = STEEPNESS * (unit[:, :1] - CENTER) ** 2
    return seen(np.zeros((len(unit), 1, 1, 1)), divergence)


ONE = Observed(np.zeros((1, 1, 1)), np.zeros(1, int), ("x",), ("x/x",))


def test_one_step_is_the_literal_loop_of_algorithm_1() -> None:
    settings = paper.PaperSettings(particles=12, alpha=3.0, sigma=0.02, tau=0.0)
    state = paper.init(np.random.default_rng(0), 1, settings)
    state, _ = paper.step(np.random.default_rng(1), state, quadratic, ONE, settings)
    new, info = paper.step(np.random.default_rng(2), state, quadratic, ONE, settings)

    rng = np.random.default_rng(2)
    parents = rng.choice(12, size=12, p=state.weights)
    noise = rng.standard_normal((12, 1))
    particles, weights = [], []
    for i in range(12):  # line 4
        xi = state.particles[parents[i], 0] + settings.sigma * noise[i, 0]  # line 5
        xi = -xi if xi < 0 else 2 - xi if xi > 1 else xi
        discrepancy = STEEPNESS * (xi - CENTER) ** 2  # lines 6 to 8
        particles.append(xi)
        weights.append(np.exp(-settings.alpha * discrepancy))  # line 9
    total = sum(weights)  # line 10
    assert new.particles[:, 0] == pytest.approx(particles)
    assert new.weights == pytest.approx([w / total for w in weights])
    assert info.ess == pytest.approx(1 / sum((w / total) ** 2 for w in weights))  # line 11
    assert not info.resampled


def test_low_effective_sample_size_resamples_and_resets_the_weights() -> None:
    settings = paper.PaperSettings(particles=50, alpha=1000.0, tau=0.5)
    state = paper.init(np.random.default_rng(0), 1, settings)
    state, info = paper.step(np.random.default_rng(1), state, quadratic, ONE, settings)
    assert info.resampled and info.ess < 25
    assert np.all(state.weights == 1 / 50)
    assert len(np.unique(state.particles)) < 25


def test_the_first_generation_without_perturbation_is_the_exact_generalised_posterior() -> None:
    """Mean and variance of prior x exp(-alpha D), by quadrature; 4000 particles, five standard errors."""
    settings = paper.PaperSettings(particles=4000, alpha=2.0, sigma=0.0, tau=0.0)
    state = paper.init(np.random.default_rng(0), 1, settings)
    state, info = paper.step(np.random.default_rng(1), state, quadratic, ONE, settings)
    grid = np.linspace(0, 1, 10001)
    density = np.exp(-2.0 * STEEPNESS * (grid - CENTER) ** 2)
    mean = np.average(grid, weights=density)
    variance = np.average((grid - mean) ** 2, weights=density)
    found, spread = mean_and_variance(state.particles, state.weights)
    assert found[0] == pytest.approx(mean, abs=5 * np.sqrt(2 * variance / info.ess))
    assert spread[0] == pytest.approx(variance, rel=5 * np.sqrt(4 / info.ess))


def test_iterating_narrows_as_the_algorithm_must_whatever_the_data_say() -> None:
    """The same data weigh again in each generation: 1 / v' = 1 / (v + sigma^2) + 1 / s^2."""
    settings = paper.PaperSettings(particles=4000, alpha=2.0, sigma=0.02, tau=0.0, mean_threshold=0.0)
    state = paper.init(np.random.default_rng(0), 1, settings)
    likelihood = 1 / (2 * settings.alpha * STEEPNESS)
    variance = None
    for t in range(6):
        state, _ = paper.step(np.random.default_rng([5, t]), state, quadratic, ONE, settings)
        _, found = mean_and_variance(state.particles, state.weights)
        if variance is not None:
            variance = 1 / (1 / (variance + settings.sigma**2) + 1 / likelihood)
            assert found[0] == pytest.approx(variance, rel=0.2)
        else:
            variance = found[0]
    assert variance < 0.3 * likelihood


def test_diverged_simulations_weigh_nothing() -> None:
    def half(unit: np.ndarray) -> Features:
        features = quadratic(unit)
        return features._replace(valid=unit[:, 0] > 0.5)

    settings = paper.PaperSettings(particles=40, tau=0.0)
    state, _ = paper.step(
        np.random.default_rng(1), paper.init(np.random.default_rng(0), 1, settings), half, ONE, settings
    )
    assert np.all(state.weights[state.particles[:, 0] <= 0.5] == 0)
    assert np.isfinite(state.mean).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_particles_whose_divergence_is_not_finite_weigh_nothing(value: float) -> None:
    def some(unit: np.ndarray) -> Features:
        features = quadratic(unit)
        return features._replace(divergence=np.where(unit > 0.5, features.divergence, value))

    for alpha in (10.0, 0.0):  # without the data's say, too
        settings = paper.PaperSettings(particles=40, tau=0.0, alpha=alpha)
        state, info = paper.step(
            np.random.default_rng(1), paper.init(np.random.default_rng(0), 1, settings), some, ONE, settings
        )
        assert np.all(state.weights[state.particles[:, 0] <= 0.5] == 0) and state.weights.sum() == pytest.approx(1)
        assert info.ess < 40 and np.isfinite(info.divergence).all()


def test_a_divergence_that_is_finite_nowhere_is_an_error() -> None:
    def none(unit: np.ndarray) -> Features:
        return quadratic(unit)._replace(divergence=np.full((len(unit), 1), np.nan))

    settings = paper.PaperSettings(particles=40)
    state = paper.init(np.random.default_rng(0), 1, settings)
    with pytest.raises(InferError, match="the divergence of x/x is not finite, so no simulation can be weighed"):
        paper.step(np.random.default_rng(1), state, none, ONE, settings)


def test_converges_when_mean_and_reward_stand_still_and_never_past_the_bound() -> None:
    def rewarded(unit: np.ndarray) -> Features:
        return quadratic(unit)._replace(reward=np.full(len(unit), 7.0))

    settings = paper.PaperSettings(particles=200, alpha=50.0, sigma=0.002, generations=15)
    state = paper.init(np.random.default_rng(0), 1, settings)
    while not paper.finished(state, settings):
        state, _ = paper.step(np.random.default_rng([1, state.generation]), state, rewarded, ONE, settings)
    assert state.converged and 1 < state.generation < 15
    _, log_weights = paper.posterior(state)
    assert normalised(log_weights).sum() == pytest.approx(1.0)


def test_reward_that_still_improves_holds_convergence_back() -> None:
    rising = iter(np.arange(1.0, 100.0))

    def rewarded(unit: np.ndarray) -> Features:
        return quadratic(unit)._replace(reward=np.full(len(unit), next(rising)))

    settings = paper.PaperSettings(particles=200, alpha=50.0, sigma=0.002, generations=10)
    state = paper.init(np.random.default_rng(0), 1, settings)
    while not paper.finished(state, settings):
        state, _ = paper.step(np.random.default_rng([1, state.generation]), state, rewarded, ONE, settings)
    assert not state.converged and state.generation == 10


def test_perturbation_never_leaves_the_prior() -> None:
    assert np.all(
        (paper.reflected(np.linspace(-0.9, 1.9, 57)) >= 0) & (paper.reflected(np.linspace(-0.9, 1.9, 57)) <= 1)
    )
    assert paper.reflected(np.array([-0.1, 0.3, 1.2])) == pytest.approx([0.1, 0.3, 0.8])


def test_the_reward_alone_is_an_ablation_of_its_own() -> None:
    walking = hexapod_rollouts("gait:tripod", "gait:squat", count=4)
    problem = Problem.of(base_model("hexapod"), walking, statistics=("reward",), timestep=0.01)
    found = infer(problem, "paper", particles=10, generations=2)
    assert found.statistics == ("reward",) and np.isfinite(found.particles).all()
    assert [len(g["divergence"]) for g in found.generations] == [1, 1]
    assert not any(e.identified for e in found.estimates), "the method's width says nothing of the data"
