"""The score of a probabilistic prediction and its band, against values known otherwise."""

import numpy as np
import pytest
from scipy.special import erf

from tcbi_infer.compare.scores import crps, predictive_band


def test_the_score_of_one_gaussian_is_the_integral_of_its_definition():
    x = np.linspace(-12, 12, 200_001)
    for measured, sigma in ((0.0, 1.0), (1.3, 0.7), (-2.0, 2.0)):
        cumulative = 0.5 * (1 + erf(x / sigma / np.sqrt(2)))
        expected = np.trapezoid((cumulative - (x >= measured)) ** 2, x)
        assert crps(np.array(measured), np.zeros((1,)), sigma) == pytest.approx(expected, abs=1e-3)


def test_a_perfect_prediction_scores_the_noise_over_the_root_of_pi():
    rng = np.random.default_rng(0)
    measured = rng.normal(0, 0.3, 40_000)
    assert crps(measured, np.zeros((1, 40_000)), 0.3).mean() == pytest.approx(0.3 / np.sqrt(np.pi), rel=0.02)


def test_the_score_does_not_depend_on_how_many_draws_were_made():
    """Six standard errors of the mean over 40 000 samples: fails by chance once in some 10^8 runs."""
    rng = np.random.default_rng(1)
    measured = rng.normal(0, np.hypot(1.0, 0.5), 40_000)
    scores = [crps(measured, rng.normal(0, 1.0, (n, 40_000)), 0.5).mean() for n in (2, 4, 16)]
    assert np.ptp(scores) < 6 * 1.1 / np.sqrt(40_000)


def test_no_other_spread_and_no_other_mean_scores_better_than_the_right_one():
    rng = np.random.default_rng(2)
    measured = rng.normal(0, 1.0, 20_000)
    right, narrow, wide = (crps(measured, rng.normal(0, s, (8, 20_000)), 0.1).mean() for s in (0.995, 0.3, 3.0))
    shifted = crps(measured, 0.7 + rng.normal(0, 0.995, (8, 20_000)), 0.1).mean()
    assert right < min(narrow, wide, shifted)


def test_draws_that_are_all_alike_score_as_one():
    measured = np.array([0.4, -1.0])
    assert crps(measured, np.zeros((5, 2)), 0.2) == pytest.approx(crps(measured, np.zeros((1, 2)), 0.2))


def test_the_band_holds_nine_tenths_of_what_is_drawn_from_it():
    rng = np.random.default_rng(3)
    low, high = predictive_band(rng.normal(0, 1.0, (64, 20_000)), 0.5)
    measured = rng.normal(0, np.hypot(1.0, 0.5), 20_000)
    assert np.mean((measured >= low) & (measured <= high)) == pytest.approx(0.9, abs=0.02)
