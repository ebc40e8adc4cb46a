"""Where the screening looks at an effect."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tcbi_infer.diagnose.screen import SIZES, effect_points, with_sums
from tcbi_sim.model import base_model
from tcbi_sim.parameter import Parameter

HEXAPOD = base_model("hexapod")


def points(use: str, many: bool = False) -> np.ndarray:
    return effect_points(HEXAPOD.with_effect(use), len(HEXAPOD.parameters), many)


def test_a_place_has_its_corners_with_the_larger_size_only() -> None:
    size = Parameter("size", "kg", 0.0, 1.0, 0.5, null=0.0)
    place = tuple(Parameter(name, "m", -1.0, 1.0, 0.0) for name in "xy")
    box: Any = SimpleNamespace(parameters=(size, *place))
    looked_at = effect_points(box, 0, many=False)
    sizes, places = looked_at[:, 0], looked_at[:, 1:]
    assert np.unique(sizes).tolist() == pytest.approx(list(SIZES)) and len(looked_at) == 6
    assert places[np.argmin(sizes)].tolist() == pytest.approx([0.5, 0.5])
    assert len(np.unique(places[sizes > SIZES[0] + 1e-9], axis=0)) == 5


def test_a_payload_and_its_moments_are_simulated_alone_and_together_are_sums() -> None:
    null, looked_at = np.array([0.0, 0.5, 0.5]), points("payload")
    assert len(looked_at) == 6 and np.all((looked_at != null).sum(axis=1) == 1)
    every, _ = with_sums(null, looked_at, looked_at)
    assert [SIZES[-1], 0.5 - SIZES[-1] / 2, 0.5 + SIZES[-1] / 2] in np.round(every, 9).tolist()


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
