"""Divergences: zero for equals, the known value where there is one, bounded, no matter how degenerate the samples."""

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from tcbi_infer.divergence import DIVERGENCES, LOG2, Binning, divergence, js, js_binned, js_nearest, wasserstein
from tcbi_infer.errors import InferError
from tcbi_sim.errors import UnknownNameError


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.mark.parametrize("name", sorted(DIVERGENCES))
def test_grows_with_the_distance_between_the_distributions(name: str, rng: np.random.Generator) -> None:
    real = rng.standard_normal(500)
    values = divergence(name)(real, np.stack([rng.standard_normal(500) + shift for shift in (0.0, 0.5, 1.0, 2.0)]))
    assert np.all(np.diff(values) > 0)
    assert values[0] < 0.2 * values[-1]


@pytest.mark.parametrize("name", ["js", "wasserstein"])
def test_of_the_same_samples_is_zero(name: str, rng: np.random.Generator) -> None:
    real = rng.standard_normal(100)
    assert divergence(name)(real, real[None])[0] == pytest.approx(0.0, abs=1e-12)


def test_js_is_the_divergence_and_not_its_square_root(rng: np.random.Generator) -> None:
    p, q = rng.random(20), rng.random(20)
    assert js_binned(p, q) == pytest.approx(jensenshannon(p, q) ** 2)


def test_js_of_separate_samples_is_log_two() -> None:
    assert js(np.linspace(0, 1, 50), np.linspace(5, 6, 50)[None])[0] == pytest.approx(LOG2)
    assert js_nearest(np.linspace(0, 1, 50), np.linspace(5, 6, 50)[None])[0] == pytest.approx(LOG2, abs=1e-6)


def test_js_nearest_agrees_with_the_integral(rng: np.random.Generator) -> None:
    grid = np.linspace(-8, 9, 20001)
    p, q = np.exp(-(grid**2) / 2), np.exp(-((grid - 1.5) ** 2) / 2)
    exact = jensenshannon(p, q) ** 2
    found = js_nearest(rng.standard_normal(4000), rng.standard_normal((1, 4000)) + 1.5, k=50)[0]
    assert found == pytest.approx(exact, abs=0.03)


def test_wasserstein_of_a_shift_is_the_shift_in_ranges() -> None:
    real = np.linspace(0, 2, 401)
    assert wasserstein(real, real[None] + 0.5)[0] == pytest.approx(0.25)


def test_missing_samples_are_dropped_and_infinite_ones_fall_in_the_tails() -> None:
    binning = Binning.of(np.array([0.0, 1.0, np.nan]))
    counts = binning.counts(np.array([[0.5, np.nan, np.inf, -np.inf, 7.0]]))[0]
    assert counts.sum() == 4
    assert (counts[0], counts[-1]) == (1, 2)


def test_a_constant_statistic_has_bins_that_tell_lower_equal_and_higher() -> None:
    binning = Binning.of(np.full(10, 3.0))
    counts = binning.counts(np.array([[2.9, 3.0, 3.1]]))[0]
    assert counts[0] == 1 and counts[-1] == 1 and counts[1:-1].sum() == 1


def test_no_finite_sample_is_refused() -> None:
    with pytest.raises(InferError, match="no finite sample"):
        Binning.of(np.array([np.nan]))


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="js_nearest"):
        divergence("kullback")
