"""What is said of a posterior at a bound: that the model is wrong only where it fits poorly."""

import numpy as np
import pytest

from tcbi_infer.tcbi.method import Generation
from tcbi_infer.tcbi.result import misfits, piled
from tcbi_sim.parameter import Parameter

GAP = Parameter("gap", "rad", 0.0, 0.1, 0.03, null=0.0)
MASS = Parameter("mass", "kg", 0.5, 1.5, 1.0)
AT_BOUND = np.column_stack([np.linspace(0.001, 0.01, 40), np.linspace(0.2, 0.8, 40)])
EQUAL = np.zeros(40)


def last(misfit: float | None) -> Generation:
    """A generation whose remaining divergence is `misfit` times the noise; None for a method that knows neither."""
    notes = {} if misfit is None else {"floor_noise": [1.0], "floor_misfit": [misfit], "best": AT_BOUND[:5].tolist()}
    return Generation(40.0, 0.5, np.zeros(1), notes)


@pytest.mark.parametrize("misfit", [0.1, None])
def test_a_posterior_at_a_bound_that_fits_well_is_no_sign_of_a_wrong_model(misfit: float | None) -> None:
    assert misfits((GAP, MASS), AT_BOUND, EQUAL, ["x"], last(misfit)) == []
    assert piled((GAP, MASS), AT_BOUND, EQUAL, last(misfit)) == [
        "the posterior of gap piles up at its low end, 0 rad, where the effect is absent"
    ]


def test_a_bound_that_is_not_the_null_value_may_cut_the_posterior_off() -> None:
    (line,) = piled((MASS, GAP), 1 - AT_BOUND, EQUAL, last(0.1))
    assert line.startswith("the posterior of mass piles up at its high end, 1.5 kg, which may cut it off")


def test_a_posterior_at_a_bound_that_fits_poorly_says_that_the_prior_seems_to_exclude_the_data() -> None:
    (line,) = misfits((GAP, MASS), AT_BOUND, EQUAL, ["x"], last(2.0))
    assert line.startswith("the prior of gap seems to exclude the data: what fits best lies at its low end, 0 rad, and")
    assert piled((GAP, MASS), AT_BOUND, EQUAL, last(2.0)) == []


def test_a_posterior_within_its_bounds_needs_no_line() -> None:
    inside = np.tile(AT_BOUND[:, 1:], 2)
    assert piled((GAP, MASS), inside, EQUAL, last(0.1)) == []
