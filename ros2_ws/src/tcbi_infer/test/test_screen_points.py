"""Where the screening looks at an effect."""

import numpy as np
import pytest

from tcbi_infer.diagnose.screen import SIZES, effect_points, with_sums
from tcbi_sim.model import base_model

HEXAPOD = base_model("hexapod")


def points(use: str, many: bool = False) -> np.ndarray:
    return effect_points(HEXAPOD.with_effect(use), len(HEXAPOD.parameters), many)


def test_a_place_has_its_corners_with_the_larger_size_only() -> None:
    looked_at = points("payload")
    mass, places = looked_at[:, 0], looked_at[:, 1:]
    assert np.unique(mass).tolist() == pytest.approx(list(SIZES)) and len(looked_at) == 6
    assert places[np.argmin(mass)].tolist() == pytest.approx([0.5, 0.5])
    assert len(np.unique(places[mass > SIZES[0] + 1e-9], axis=0)) == 5


def test_of_a_bias_each_axis_is_simulated_each_way_and_all_together_are_sums() -> None:
    looked_at = points("gyro_bias")
    null = np.full(3, 0.5)
    assert len(looked_at) == 6 and np.all((looked_at != null).sum(axis=1) == 1)
    slopes = np.array([1.0, -2.0, 4.0])
    every, change = with_sums(null, looked_at, (looked_at - null) @ slopes)
    assert len(every) == 26 == len(np.unique(every, axis=0)), "3 x 3 x 3 but for the null itself"
    assert change == pytest.approx((every - null) @ slopes)
    assert np.abs(every - null).max() == pytest.approx(SIZES[-1] / 2)


def test_what_has_a_threshold_is_simulated_together() -> None:
    looked_at = points("soft_ground")
    assert [SIZES[-1]] * 2 in np.round(looked_at, 9).tolist()
    assert len(points("weak_leg:lf", many=True)) == 1
