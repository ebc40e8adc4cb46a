"""What is said of a posterior at a bound: that the model is wrong only where it fits poorly."""

from typing import Any

import numpy as np
import pytest

from tcbi_infer.tcbi.goodness import goodness_of_fit, piled, strays
from tcbi_infer.tcbi.method import Generation
from tcbi_infer.tcbi.predictive import JOINTS, TILTS, Departure, Departures
from tcbi_infer.tcbi.result import IDENTIFIED_BELOW, estimates
from tcbi_sim.parameter import Parameter

GAP = Parameter("gap", "rad", 0.0, 0.1, 0.03, null=0.0)
MASS = Parameter("mass", "kg", 0.5, 1.5, 1.0)
AT_BOUND = np.column_stack([np.linspace(0.001, 0.01, 40), np.linspace(0.2, 0.8, 40)])
EQUAL = np.zeros(40)


def last(misfit: float | None) -> Generation:
    """A generation whose remaining divergence is `misfit` times the noise; None for a method that knows neither."""
    notes = {} if misfit is None else {"floor_noise": [1.0], "floor_misfit": [misfit], "best": AT_BOUND[:5].tolist()}
    return Generation(40.0, 0.5, np.zeros(1), notes)


def told(*args: Any) -> tuple[list[str], bool | None]:
    """What is said of a fit, and whether it is one."""
    return goodness_of_fit(*args)[:2]


@pytest.mark.parametrize("misfit", [0.1, None])
def test_a_posterior_at_a_bound_that_fits_well_is_no_sign_of_a_wrong_model(misfit: float | None) -> None:
    assert told((GAP, MASS), AT_BOUND, EQUAL, ["x"], last(misfit), None) == ([], True)
    assert piled((GAP, MASS), AT_BOUND, EQUAL, last(misfit)) == [
        "the posterior of gap piles up at its low end, 0 rad, where the effect is absent"
    ]


def test_a_bound_that_is_not_the_null_value_may_cut_the_posterior_off() -> None:
    (line,) = piled((MASS, GAP), 1 - AT_BOUND, EQUAL, last(0.1))
    assert line.startswith("the posterior of mass piles up at its high end, 1.5 kg, which may cut it off")


def test_a_posterior_at_a_bound_that_fits_poorly_says_that_the_prior_seems_to_exclude_the_data() -> None:
    (line,), fits = told((MASS, GAP), AT_BOUND, EQUAL, ["x"], last(2.0), last(2.1))
    assert fits is False
    assert line.startswith("the prior of mass seems to exclude the data: what fits best lies at its low end, 0.5 kg")
    assert piled((MASS, GAP), AT_BOUND, EQUAL, last(2.0)) == []


INSIDE = np.full((40, 2), 0.5)


def best_at(gap: float, mass: float, prior: tuple[float, float]) -> list[str]:
    """What is said of a poor fit whose best particles lie there, both priors 0.01 wide about `prior`; all in [0, 1]."""
    draws = np.clip(np.random.default_rng(0).normal(prior, 0.01, (4000, 2)), 0, 1)
    poor = last(2.0)
    poor.notes["best"] = [[gap, mass]] * 5
    return told((GAP, MASS), INSIDE, EQUAL, ["x"], poor, last(2.1), draws)[0]


def test_a_versions_prior_excludes_the_data_where_the_best_lie_beyond_what_it_expects() -> None:
    assert best_at(0.3, 0.4, prior=(0.31, 0.41)) == []
    (line,) = best_at(0.3, 0.4, prior=(0.3, 0.6))
    assert line.startswith("the prior of mass seems to exclude the data: what fits best has 0.9 kg, where the prior")
    assert line.endswith("expects 1.08 to 1.12 kg (90%); take the flat prior, or an effect is missing")


def test_a_versions_prior_that_knows_an_effect_excludes_its_absence_and_one_that_reaches_to_it_does_not() -> None:
    (line,) = best_at(0.001, 0.5, prior=(0.3, 0.5))
    assert line.startswith("the prior of gap seems to exclude the data: what fits best has 0.0001 rad, where the prior")
    assert best_at(0.001, 0.5, prior=(0.04, 0.5)) == []


def test_where_a_versions_prior_reaches_an_end_the_range_may_still_exclude_the_data() -> None:
    (line,) = best_at(0.5, 0.99, prior=(0.5, 0.98))
    assert line.startswith("the prior of mass seems to exclude the data: what fits best lies at its high end, 1.5 kg")


def test_a_range_beyond_which_predictions_come_nearest_excludes_the_data_where_the_model_is_wrong() -> None:
    def said(gap: float, mass: float, missed: float = 9.0) -> list[str]:
        departed = Departures({JOINTS: Departure(missed, 4.0, 0.1, ())}, 0, (gap, mass))
        lines = told((GAP, MASS), INSIDE, EQUAL, ["x"], last(0.1), last(0.1), None, departed)[0]
        return [line for line in lines if "exclude" in line]

    (line,) = said(0.5, 1.2)
    assert line.startswith(
        "the prior of mass seems to exclude the data: predictions come nearest to the robot's motion"
    )
    assert "with values above its end of 1.5 kg; its range" in line
    assert "below its end of 0.5 kg" in said(0.5, -0.2)[0] and "above its end of 0.1 rad" in said(1.2, 0.5)[0]
    assert said(-0.5, 0.5) == [], "beyond the null value there is nothing"
    assert said(0.5, 1.05) == [], "extrapolations are rough"
    assert said(0.5, 1.2, missed=1.0) == [], "the model fits"


def test_an_interval_that_reaches_a_bound_of_a_parameter_that_is_told_may_be_cut_off() -> None:
    low = np.column_stack([np.linspace(0.001, 0.3, 40), np.linspace(0.001, 0.3, 40)])
    assert piled((GAP, MASS), low, EQUAL, last(0.1)) == []
    (line,) = piled((GAP, MASS), low, EQUAL, last(0.1), {"gap", "mass"})
    assert line.startswith("the posterior of mass reaches its low end, 0.5 kg, which may cut it off")
    assert piled((GAP, MASS), low + 0.1, EQUAL, last(0.1), {"gap", "mass"}) == []


def test_an_effect_that_is_absent_is_told_so_and_no_wider_prior_is_asked_for() -> None:
    assert told((GAP, MASS), AT_BOUND, EQUAL, ["x"], last(2.0), last(2.1)) == ([], True)
    assert "where the effect is absent" in piled((GAP, MASS), AT_BOUND, EQUAL, last(2.0))[0]


def test_a_posterior_within_its_bounds_needs_no_line() -> None:
    inside = np.tile(AT_BOUND[:, 1:], 2)
    assert piled((GAP, MASS), inside, EQUAL, last(0.1)) == []


@pytest.mark.parametrize("misfit", [2.0, 9.0])
@pytest.mark.parametrize("before", [None, 1.2])
def test_a_search_that_still_finds_better_fits_cannot_tell_whether_the_model_fits(
    misfit: float, before: float | None
) -> None:
    earlier = None if before is None else last(before * misfit)
    (line,), fits = told((MASS, GAP), AT_BOUND, EQUAL, ["x"], last(misfit), earlier)
    assert fits is None
    assert line.startswith("too few particles or generations to tell whether the model fits") and "effect" not in line


def test_what_has_stopped_falling_is_said_whatever_else_still_falls() -> None:
    def both(first: float, second: float) -> Generation:
        return Generation(40.0, 0.5, np.zeros(2), {"floor_noise": [1.0, 1.0], "floor_misfit": [first, second]})

    inside = np.full((40, 2), 0.5)
    (line,), fits = told((GAP, MASS), inside, EQUAL, ["x", "y"], both(9.0, 6.0), both(9.5, 12.0))
    assert fits is False and line.startswith("no parameters reproduce x: what remains of its divergence is 9 times")
    assert told((GAP, MASS), inside, EQUAL, ["x", "y"], both(1.0, 3.0), both(9.5, 12.0)) == ([], True)


def test_one_channel_that_nothing_reproduces_is_said_though_its_statistic_fits_in_the_mean() -> None:
    def one_of(several: dict[str, float]) -> Generation:
        notes = {"floor_noise": [1.0], "floor_misfit": [float(np.mean(list(several.values())))], "misfit": several}
        return Generation(40.0, 0.5, np.zeros(1), notes)

    fine, inside = {f"x/{i}": 0.9 for i in range(17)}, np.full((40, 2), 0.5)
    (line,), fits = told((GAP, MASS), inside, EQUAL, ["x"], one_of(fine | {"x/knee": 8.0}), one_of({"x/knee": 8.1}))
    assert fits is False and line.startswith(
        "no parameters reproduce x/knee: what remains of its divergence is 8 times"
    )
    (line,), fits = told((GAP, MASS), inside, EQUAL, ["x"], one_of(fine | {"x/knee": 8.0}), one_of({"x/knee": 16.0}))
    assert fits is None and "x/knee" in line
    all_fine = one_of(fine | {"x/knee": 5.0})
    assert told((GAP, MASS), inside, EQUAL, ["x"], all_fine, all_fine) == ([], True)


def test_a_motion_that_no_draw_makes_is_no_fit_and_the_data_count_less_for_it() -> None:
    def judged(
        missed: float, apart: float = 4.0, misfit: float = 1.0, before: float = 1.0, error: float = 0.0123
    ) -> tuple[list[str], bool | None, float]:
        seen, both = Departures({JOINTS: Departure(missed, apart, error, ())}, 0), (last(misfit), last(before))
        return goodness_of_fit((GAP, MASS), INSIDE, EQUAL, ["x"], *both, None, seen)

    assert judged(1.9) == ([], True, 1.0)
    assert judged(9.0, 0.9) == ([], True, 1.0), "what is missed hides in the posterior's width"
    assert judged(9.0, error=0.005) == ([], True, 1.0), "what is missed is less than encoders resolve"
    (line,), fits, distrust = judged(3.0)
    assert fits is False and distrust == 16.0
    assert line.startswith("no parameters reproduce joint positions in time: predictions with the best")
    assert "miss the robot's by 0.7 deg, 3.0 times as much as each other's" in line
    assert judged(3.0, 4.0, 9.0, 9.1)[2] == 16.0 and judged(1.9, 4.0, 9.0, 9.1)[2] == 9.0
    assert judged(3.0, 4.0, 9.0, 20.0)[1] is None, "a search that still finds better fits comes first"


def test_a_rollout_that_predictions_miss_far_more_than_the_others_is_named_where_few_are() -> None:
    def named(*each: float, signal: str = JOINTS) -> list[str]:
        return strays(Departures({signal: Departure(1.0, 1.0, 0.1, each)}, 0), [f"r{i}" for i in range(len(each))])

    (line,) = named(1.0, 1.2, 6.1, 1.1, 0.9, 1.3)
    assert line.startswith("r2 is unlike the other rollouts: predictions miss its joint positions 5 times as much")
    assert named(1.0, 1.2, 4.1, 1.1, 0.9, 1.3) == [], "less than four times the one in the middle"
    assert named(0.2, 0.2, 1.1, 0.2, 0.2, 0.2) == [], "predictions miss it as they miss each other"
    assert named(1.0, 1.0, 9.0, 1.0, 9.0, 1.0) == [], "a third of them is no exception"
    assert named(1.0, 1.0, 9.0) == [], "three are too few to see which one is unlike the others"
    assert named(1.0, 1.0, 3.9, 0.5, signal=TILTS) == [], "attitudes may depart further"


@pytest.mark.parametrize("count", [10, 20])
def test_a_parameter_that_is_not_told_is_called_told_in_one_of_twenty_at_most(count: int) -> None:
    """Posteriors at the limit, of normal shape: of `count` particles; above 6.5 % of 1500 by chance in 1 of 250."""
    sd = np.sqrt(IDENTIFIED_BELOW / 12)
    draws = 0.5 + sd * np.random.default_rng(0).standard_normal((1500, count, 1))
    told = [estimates((MASS,), unit, np.zeros(count))[0].identified for unit in draws]
    assert 0.035 < np.mean(told) < 0.065
