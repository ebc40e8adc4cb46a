"""Held-out gains of several kinds of motion: their total, its standard error, and the limit that chance passes."""

import numpy as np
import pytest

from tcbi_infer.diagnose import paired


def test_a_recording_half_as_long_may_gain_half_as_much():
    gains, alike, sizes = np.array([40.0, 42.0, 38.0, 20.0]), np.full(4, 9), np.array([10, 10, 10, 5])
    assert paired.statistic(gains, sizes) > 1.5 * paired.statistic(gains, alike)
    gain, se = paired.total(gains, alike)
    assert gain == gains.sum() and gain / se == pytest.approx(gains.mean() / (gains.std(ddof=1) / 2))
    assert paired.statistic(gains[:1], sizes[:1]) == 0.0 and np.isnan(paired.total(gains[:1], sizes[:1])[1])


def test_one_motion_in_which_a_foot_slipped_otherwise_does_not_decide():
    gains, sizes = np.array([219.0, 381, -401, 270, 300, 342, 245]), np.ones(7)
    assert gains.mean() / (gains.std(ddof=1) / np.sqrt(7)) < 2.0 < 5.0 < paired.statistic(gains, sizes)
    assert paired.statistic(np.array([0.0, 0, 900, 0, 0, 0, 0]), sizes) == 0.0  # nor does one alone prove anything


@pytest.mark.parametrize(("spread", "half"), [(0.0, 1), (1.0, 0), (1.0, 1)])
@pytest.mark.parametrize("kinds", [5, 7, 9])
def test_a_gain_of_pure_chance_passes_the_limit_as_seldom_as_it_says(kinds, spread, half):
    """Also where motions show what they show more or less, by a factor of 2.7 and more, or some are shorter."""
    rng = np.random.default_rng(3)
    sizes = np.array([1] * half + [2] * (kinds - half))
    gains = rng.normal(size=(kinds, 20_000)) * 100 * np.exp(spread * rng.normal(size=(kinds, 20_000)))
    share = (paired.statistic(gains * sizes[:, None], sizes) > paired.limit(kinds)).mean()
    aimed = 1 - paired.level(kinds)
    assert (0.4 if spread else 0.8) * aimed < share < 1.15 * aimed


def test_motions_that_show_an_effect_more_or_less_all_speak_for_it():
    gains, sizes = np.array([254.0, 91, 245, 113, 99]), np.ones(5)
    gain, se = paired.total(gains, sizes)
    assert gain / se < 3.0 and paired.statistic(gains, sizes) > paired.limit(5)


def test_where_the_base_model_diverges_in_several_motions_these_count_as_the_largest_finite_gain():
    gains, sizes = np.array([np.inf, np.inf, 28.0, 25.0, 27.0]), np.ones(5)
    assert paired.statistic(gains, sizes) == paired.statistic(np.where(np.isinf(gains), 28.0, gains), sizes) > 5
    few = np.array([np.inf, 28.0, 25.0])
    assert paired.total(few, np.ones(3))[0] == 81.0
    assert paired.total(np.full(5, np.inf), sizes)[0] == -np.inf  # nothing to compare with
