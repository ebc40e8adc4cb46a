"""Divergences: zero for equals, the known value where there is one, bounded, no matter how degenerate the samples."""

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from tcbi_infer.divergence import DIVERGENCES, LOG2, Binning, divergence, js, js_binned, js_nearest, wasserstein
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.features import Observed, divergences, resampled_divergences
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


@pytest.mark.parametrize(
    "values",
    [np.full(50, 3.0), np.repeat([0.0, 1.0], 50), np.repeat([0.0, 0.5, 1.0], 40), np.linspace(1e6, 1e6 + 1e-3, 60)],
    ids=["constant", "binary", "thirds", "identical"],
)
def test_js_nearest_of_equal_samples_with_ties_is_about_zero_and_of_separate_ones_log_two(values: np.ndarray) -> None:
    assert js_nearest(values, values[None])[0] == pytest.approx(0.0, abs=0.006)
    assert js_nearest(values, values[None, ::-1])[0] == pytest.approx(0.0, abs=0.006)
    assert js_nearest(values, values[None] + 5.0)[0] == pytest.approx(LOG2, abs=1e-6)


def test_js_nearest_of_two_shares_of_ones_is_the_divergence_of_the_shares() -> None:
    real, simulated = np.repeat([0.0, 1.0], [800, 200]), np.repeat([0.0, 1.0], [200, 800])
    exact = jensenshannon([0.8, 0.2], [0.2, 0.8]) ** 2
    assert js_nearest(real, simulated[None])[0] == pytest.approx(exact, abs=0.01)


def test_js_nearest_without_ties_counts_the_k_nearest(rng: np.random.Generator) -> None:
    real, simulated = rng.standard_normal(60), rng.standard_normal(60) + 0.7
    pooled, origin = np.concatenate([real, simulated]), np.repeat([0, 1], 60)
    shares = [origin[np.argsort(np.abs(pooled - x))[1:11]].mean() for x in pooled]
    share = np.clip(shares, 1e-12, 1 - 1e-12)
    expected = LOG2 + np.mean(share * np.log(share) + (1 - share) * np.log(1 - share))
    assert js_nearest(real, simulated[None])[0] == pytest.approx(expected)


@pytest.mark.parametrize("real", [np.full(20, 3.0), np.linspace(0, 2, 20)], ids=["constant", "spread"])
def test_wasserstein_is_bounded_and_never_falls_with_the_distance(real: np.ndarray) -> None:
    shifts = np.array([0.0, 1e-6, 1e-3, 1.0, 30.0, 1e6])
    values = wasserstein(real, real + shifts[:, None])
    assert values[0] == 0 and np.all(np.diff(values) >= -1e-9) and values[-1] <= 10.0
    assert wasserstein(real, np.full((1, 5), np.nan))[0] == 10.0


def test_wasserstein_of_a_constant_tells_how_much_of_a_simulation_lies_elsewhere() -> None:
    real, some, most = np.full(1000, 3.0), np.repeat([3.0, 4.0], [900, 100]), np.repeat([3.0, 4.0], [100, 900])
    assert wasserstein(real, np.stack([real, some, most])) == pytest.approx([0.0, 1.0, 9.0], abs=0.01)
    assert wasserstein(np.full(10, 0.3), np.full((1, 10), 0.1 + 0.2))[0] < 1e-6, "rounding is no distance"


def test_one_outlier_of_the_robot_does_not_shrink_the_wasserstein_distance_of_all_others() -> None:
    real = np.linspace(0.0, 1.0, 400)
    shifted = real[None] + 0.5
    spoilt = np.append(real, 1000.0)
    few = np.append(np.linspace(0.0, 1.0, 40), 1e6)
    assert wasserstein(few, np.linspace(0.0, 1.0, 40)[None])[0] < 0.1, "nor does it make a right simulation wrong"
    assert wasserstein(spoilt, shifted)[0] > 0.45 * wasserstein(real, shifted)[0], "the outlier may double the range"


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


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("count", [20, 100, 2000])
def test_one_outlier_leaves_the_bins_to_the_other_samples(count: int, side: float, rng: np.random.Generator) -> None:
    usual = rng.standard_normal(count)
    binning = Binning.of(np.append(usual, side * 1e4))
    counts = binning.counts(np.append(usual, side * 1e4)[None])[0]
    assert np.count_nonzero(counts[1:-1]) >= 6 and counts[0 if side < 0 else -1] == 1


@pytest.mark.parametrize("shape", ["normal", "uniform", "laplace"])
def test_samples_without_outliers_have_bins_over_their_range(shape: str, rng: np.random.Generator) -> None:
    for count in (20, 100, 2000):
        samples = getattr(rng, shape)(size=count)
        binning = Binning.of(samples)
        assert (binning.low, binning.high) == pytest.approx((samples.min(), samples.max()), abs=1e-6)


def test_few_samples_beside_a_constant_keep_their_bins() -> None:
    """As of a foot that nearly always stands: the inner 99 % are no range."""
    assert Binning.of(np.repeat([0.2, 1.0], [2, 998])).low == pytest.approx(0.2)


@pytest.mark.parametrize("bins", [-1, 0, 2])
def test_bins_of_which_all_are_tails_are_refused(bins: int) -> None:
    with pytest.raises(InferError, match=f"bins: got {bins}, allowed is 3 or more"):
        Binning.of(np.arange(9.0), bins)
    assert Binning.of(np.arange(9.0), 3).counts(np.arange(9.0)[None])[0].tolist() == [0, 9, 0]


def test_no_finite_sample_is_refused() -> None:
    with pytest.raises(InferError, match="no finite sample"):
        Binning.of(np.array([np.nan]))


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="js_nearest"):
        divergence("kullback")


def test_resampled_divergences_are_those_of_the_pooled_counts() -> None:
    """Of eleven particles, more than are judged at a time; units that count twice, and channels left empty."""
    rng = np.random.default_rng(4)
    real, simulated = rng.poisson(3.0, (6, 4, 5)).astype(np.float32), rng.poisson(3.0, (11, 6, 4, 5)).astype(np.float32)
    real[:3, 1] = 0.0
    resamples = np.array([[1, 1, 1, 1, 1, 1], [3, 2, 1, 0, 0, 0], [0, 0, 2, 0, 1, 3]])
    observed = Observed(real, np.zeros(4, int), ("x",), ("x/x",) * 4)
    found = resampled_divergences(observed, simulated, resamples)
    repeated = [np.repeat(np.arange(6), units) for units in resamples]
    expected = np.stack([divergences(observed._replace(counts=real[i]), simulated[:, i]) for i in repeated], axis=1)
    assert found.shape == (11, 3, 4)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert found[:, 1, 1] == pytest.approx(np.log(2.0))
