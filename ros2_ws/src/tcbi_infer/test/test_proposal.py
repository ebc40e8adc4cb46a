"""Weights and proposals: densities that integrate to one, tempering that keeps its promise."""

import numpy as np
import pytest

from tcbi_infer.tcbi.proposal import draw, from_probit, log_mixture, log_prior, prior_proposal, proposal, to_probit
from tcbi_infer.tcbi.weights import (
    effective_sample_size,
    mean_and_variance,
    normalised,
    quantiles,
    resample,
    temper,
)


def some_proposal(points: bool = True):
    rng = np.random.default_rng(0)
    z, weights = rng.standard_normal((30, 2)), normalised(rng.standard_normal(30))
    expected = np.array([0.3, -0.2]) + 0.4 * rng.standard_normal((20, 2)) if points else None
    return proposal(100, z, weights, expected, 0.2)


def test_probit_space_makes_the_flat_prior_normal() -> None:
    unit = (np.arange(10000) + 0.5) / 10000
    z = to_probit(unit)
    assert np.allclose(from_probit(z), unit)
    assert z.std() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("points", [True, False])
def test_the_mixture_density_integrates_to_one(points: bool) -> None:
    mixture = (prior_proposal(50, 2), some_proposal(points))
    grid = np.linspace(-7, 7, 281)
    z = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    density = np.exp(log_mixture(mixture, z)) / (2 * np.pi)
    assert density.sum() * (grid[1] - grid[0]) ** 2 == pytest.approx(1.0, abs=0.01)


def test_mixture_weights_undo_the_proposal() -> None:
    """The weighted mean of prior draws is the prior's; a mean 5 standard errors off has probability 6e-7."""
    rng = np.random.default_rng(1)
    mixture = (prior_proposal(200, 2), some_proposal()._replace(size=2000))
    z = np.concatenate([draw(rng, part) for part in mixture])
    weights = normalised(log_prior(z) - log_mixture(mixture, z))
    mean, variance = mean_and_variance(z, weights)
    error = 1 / np.sqrt(effective_sample_size(weights))
    assert np.all(np.abs(mean) < 5 * error)
    assert variance == pytest.approx(np.ones(2), abs=5 * np.sqrt(2) * error)


def test_prior_draws_are_stratified() -> None:
    unit = from_probit(draw(np.random.default_rng(0), prior_proposal(50, 3)))
    for column in unit.T:
        assert sorted((column * 50).astype(int)) == list(range(50))


def test_resampling_draws_each_particle_its_expected_number_of_times() -> None:
    weights = np.array([0.5, 0.25, 0.25, 0.0])
    counts = np.bincount(resample(np.random.default_rng(0), weights, 8), minlength=4)
    assert counts.tolist() == [4, 2, 2, 0]


def test_all_zero_weights_stay_zero() -> None:
    assert normalised(np.full(3, -np.inf)).tolist() == [0, 0, 0]
    assert effective_sample_size(np.zeros(3)) == 0.0


def test_weighted_quantiles_of_equal_weights_are_plain_ones() -> None:
    values = np.arange(1000.0)[:, None]
    assert quantiles(values, np.full(1000, 1e-3), [0.05, 0.95])[:, 0] == pytest.approx([49.5, 949.5], abs=0.6)


def test_a_sample_size_that_was_asked_for_survives_the_rounding_of_weights() -> None:
    rng = np.random.default_rng(3)
    for least in np.linspace(10.0, 40.0, 31):
        energy, base = rng.exponential(size=200), np.zeros(200)
        logs = base - temper(energy, base, 1e4, least) * energy
        assert effective_sample_size(normalised(np.round(logs - logs.max(), 9))) >= least


def test_tempering_keeps_the_effective_sample_size() -> None:
    energy = np.append(np.random.default_rng(0).random(200) * 100, np.inf)
    base = np.zeros(201)
    alpha = temper(energy, base, 10.0, 40.0)
    weights = normalised(np.where(np.isfinite(energy), -alpha * np.where(np.isfinite(energy), energy, 0), -np.inf))
    assert 0 < alpha < 10
    assert effective_sample_size(weights) == pytest.approx(40, rel=0.01)
    assert temper(energy, base, 1e-6, 40.0) == 1e-6


def test_tempering_finds_the_largest_value_where_the_sample_size_rises_before_it_falls() -> None:
    """One particle has most of the prior's weight: only where its energy has taken that away do many count."""
    energy, base = np.append(np.linspace(0, 100, 200), 10.0), np.append(np.zeros(200), 5.0)
    alpha = temper(energy, base, 10.0, 7.5)
    assert effective_sample_size(normalised(base - alpha * energy)) == pytest.approx(7.5)
    assert effective_sample_size(normalised(base - 1.05 * alpha * energy)) < 7.5
    assert temper(energy, base, 0.0, 7.5) == temper(energy, base, 10.0, 1000.0) == 0.0


@pytest.mark.parametrize("prior_share", [0.0, 0.1, 0.25, 1.0])
@pytest.mark.parametrize("points", [True, False])
def test_every_number_of_particles_is_drawn_in_whole_parts(points: bool, prior_share: float) -> None:
    z, weights = np.random.default_rng(0).standard_normal((5, 2)), np.full(5, 0.2)
    expected = np.random.default_rng(1).standard_normal((7, 2)) if points else None
    for size in range(1, 201):
        part = proposal(size, z, weights, expected, prior_share)
        drawn = part.drawn
        assert min(drawn) >= 0 and sum(drawn) == size
        assert points or drawn[2] == 0, "no points to draw about"
        fresh = draw(np.random.default_rng(size), part)
        assert fresh.shape == (size, 2) and np.isfinite(log_mixture((part,), fresh)).all()
