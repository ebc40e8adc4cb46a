"""Slopes of predictions whose true slopes are known, and how few simulations they take."""

import numpy as np
import pytest

from tcbi_infer.diagnose.slopes import Slopes, both_ways

SLOPES = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, -1.0]])  # of two channels
HERE = np.array([0.5, 0.4, 0.6])


class Linear:
    """Two channels, linear but for a part that `bend` gives; it counts what is simulated."""

    def __init__(self, bend=lambda unit: 0.0):
        self.bend, self.simulated = bend, 0

    def __call__(self, units):
        self.simulated += len(units)
        values = np.atleast_2d(units) @ SLOPES.T
        return (values + np.array([[self.bend(u), 0.0] for u in np.atleast_2d(units)]))[:, None, None, :]


def at(predict, slopes, unit, radius):
    found, departure = slopes.at(unit, predict(unit[None])[0], radius)
    predict.simulated -= 1  # the place itself
    return found[0, 0], departure[0, 0]


def test_slopes_of_a_straight_line_are_exact_and_nothing_departs_from_it():
    predict = Linear()
    found, departure = at(predict, Slopes(predict), HERE, 0.1)
    np.testing.assert_allclose(found, SLOPES, atol=1e-9)
    assert np.all(departure < 1e-9) and predict.simulated == 6


def test_a_place_nearby_takes_no_more_simulations_and_one_far_off_all_of_them():
    predict = Linear()
    slopes = Slopes(predict)
    at(predict, slopes, HERE, 0.1)
    found, _ = at(predict, slopes, HERE + 0.02, 0.1)
    np.testing.assert_allclose(found, SLOPES, atol=1e-9)
    assert predict.simulated == 6
    at(predict, slopes, HERE - 0.35, 0.1)
    assert predict.simulated == 12


def test_only_the_direction_that_nothing_tells_is_simulated_anew():
    predict = Linear()
    slopes = Slopes(predict)
    units = np.concatenate([both_ways(HERE, axis, 0.1) for axis in np.eye(3)[:2]])
    slopes.remember(units, predict(units))
    predict.simulated = 0
    found, _ = at(predict, slopes, HERE, 0.1)
    np.testing.assert_allclose(found, SLOPES, atol=1e-9)
    assert predict.simulated == 2


def test_what_departs_from_the_straight_line_shows_in_its_channel_alone():
    predict = Linear(bend=lambda unit: 0.2 * (unit[1] > 0.45))
    _, departure = at(predict, Slopes(predict), HERE, 0.1)
    assert departure[0] > 0.05 and departure[1] < 1e-9


def test_slopes_follow_what_turns_on_the_way():
    predict = Linear(bend=lambda unit: 4.0 * unit[0] ** 2)
    slopes = Slopes(predict)
    for x in (0.3, 0.5, 0.7):
        place = np.array([x, 0.4, 0.6])
        found, _ = at(predict, slopes, place, 0.08)
        assert found[0, 0] == pytest.approx(1.0 + 8.0 * x, abs=1.0)  # from one place to the next 1.6


@pytest.mark.parametrize("value", [0.0, 0.03, 0.5, 0.97, 1.0])
def test_simulations_stay_in_the_range_and_apart(value):
    unit = np.array([value, 0.5])
    places = both_ways(unit, np.array([1.0, 0.0]), 0.1)
    assert np.all((places >= 0.0) & (places <= 1.0)) and abs(places[0, 0] - places[1, 0]) > 0.09
    assert np.all(np.abs(places[:, 0] - value) > 0.04)
