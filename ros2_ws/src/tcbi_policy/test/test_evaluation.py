"""Whether a policy is better is said with the confidence that is claimed."""

import numpy as np

from tcbi_policy.evaluation import Evaluation, compare_paired, draw_conditions, evaluate
from tcbi_policy.gaits import Gait
from tcbi_sim.model import base_model


def outcomes(returns: np.ndarray) -> Evaluation:
    return Evaluation(returns, np.zeros_like(returns), np.zeros_like(returns))


def test_a_gain_far_above_its_spread_is_better_and_a_loss_is_not() -> None:
    rng = np.random.default_rng(0)
    before = rng.normal(0, 100, 64)
    assert compare_paired(outcomes(before), outcomes(before + 50 + rng.normal(0, 10, 64))).better
    assert not compare_paired(outcomes(before), outcomes(before - 50)).better


def test_pairing_removes_the_spread_between_conditions() -> None:
    before = np.random.default_rng(0).normal(0, 1000, 32)
    comparison = compare_paired(outcomes(before), outcomes(before + 5 + np.arange(32) * 1e-3))
    assert comparison.better and comparison.low > 4.9


def test_equal_policies_are_called_better_in_a_twentieth_of_cases() -> None:
    """2000 draws at 5 %: a count outside 60 to 145 has a probability below 1e-5."""
    rng = np.random.default_rng(1)
    calls = [compare_paired(outcomes(np.zeros(64)), outcomes(rng.normal(size=64))).better for _ in range(2000)]
    assert 60 < sum(calls) < 145


def test_the_same_policy_is_not_better_than_itself() -> None:
    same = outcomes(np.arange(8.0))
    comparison = compare_paired(same, same)
    assert not comparison.better
    assert "not better" in comparison.statement()


def test_simulations_that_diverged_drop_out_of_both() -> None:
    before, after = np.arange(8.0), np.arange(8.0) + 1
    before[0], after[1] = np.nan, np.nan
    assert compare_paired(outcomes(before), outcomes(after)).pairs == 6
    none = np.full(8, np.nan)
    assert not compare_paired(outcomes(none), outcomes(after)).better


def test_conditions_are_a_function_of_the_seed_and_a_walk_beats_standing() -> None:
    model = base_model("hexapod")
    conditions = draw_conditions(model, "forward", 3, seed=2)
    again = draw_conditions(model, "forward", 3, seed=2)
    np.testing.assert_array_equal(conditions.parameters, again.parameters)
    assert conditions.scenarios == again.scenarios
    stand, walk = (evaluate(Gait(name), model, conditions) for name in ("stand", "tripod"))
    assert walk.mean_return > stand.mean_return + 1000
    assert np.nanmax(np.abs(stand.distance)) < 0.02
