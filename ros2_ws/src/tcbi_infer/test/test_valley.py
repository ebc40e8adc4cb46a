"""Lines along which forces and masses change together, whatever the scales of their ranges."""

import dataclasses

import numpy as np
import pytest

from tcbi_infer.diagnose.valley import is_mass, points_along, scaled_freely, shifted_freely, weakest
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

MASS = Parameter("mass", "kg", 0.4, 1.2, 0.8)
GAIN = Parameter("gain", "N m/rad", 0.1, 8.0, 1.0, scale="log")
MODEL = Model("two-v0", "hexapod", (), (MASS, GAIN), np.array([[0.8, 1.0]]), np.zeros(1))


def test_the_ratio_of_a_mass_and_a_stiffness_stays_along_their_line():
    place = np.array([MASS.to_unit(0.6), GAIN.to_unit(1.2)])
    together = np.array([0.6 / 0.8, 1.0 / np.log(80.0)])  # both by the same share, in unit space
    values = MODEL.from_unit(points_along(MODEL, place, together))
    assert np.ptp(values[:, 0]) > 0.3
    np.testing.assert_allclose(values[:, 1] / values[:, 0], 2.0, rtol=1e-5)


@pytest.mark.parametrize("place", [(0.0, 0.5), (1.0, 0.5), (0.5, 0.0), (0.02, 0.98)])
@pytest.mark.parametrize("direction", [(1.0, 0.3), (1.0, -0.3), (0.0, 1.0)])
def test_points_stay_within_the_ranges_and_are_apart_from_the_place(place, direction):
    points = points_along(MODEL, np.array(place), np.array(direction))
    assert np.all((points >= -1e-9) & (points <= 1 + 1e-9))
    assert not len(points) or np.abs(points - place).max(axis=1).min() > 1e-3


def test_forces_scale_together_until_one_is_at_its_bound():
    place = MODEL.to_unit(np.array([[0.5, 1.2]]))[0]
    scaled = scaled_freely(MODEL, 2.0, place)
    assert scaled is not None and scaled_freely(MODEL, 2.5, place) is None
    np.testing.assert_allclose(MODEL.from_unit(scaled), [1.0, 2.4])
    angle = dataclasses.replace(MASS, name="angle", unit="rad")
    rigid = Model("one-v0", "hexapod", (), (angle,), np.array([[0.8]]), np.zeros(1))
    assert scaled_freely(rigid, 1.2, np.array([0.5])) is None, "nothing to scale"


def test_one_parameter_is_shifted_until_its_range_ends():
    place = np.array([0.3, 0.6])
    np.testing.assert_allclose(shifted_freely(1, 0.3, place), [0.3, 0.9])
    assert shifted_freely(1, 0.5, place) is None and shifted_freely(0, -0.4, place) is None
    assert is_mass(MASS) and not is_mass(GAIN)


def test_the_weakest_direction_is_that_which_nothing_tells_once_the_nuisances_may_follow():
    jacobian = np.array([[1.0, 0.0, 10.0], [0.0, 2.0, 0.0]])  # the nuisance does what the first parameter does
    normal = jacobian.T @ jacobian
    assert abs(weakest(normal, 2)[0]) == pytest.approx(1.0)
