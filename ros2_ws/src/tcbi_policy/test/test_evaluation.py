"""Whether a policy is better is said with the confidence that is claimed."""

import dataclasses

import numpy as np
import pytest

from tcbi_policy.artefact import strict_json
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
    assert comparison.better and comparison.low is not None and comparison.low > 4.9


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


def diverging(count: int, of: int = 64) -> Evaluation:
    """Returns far above zero, of which the first have diverged."""
    return outcomes(np.where(np.arange(of) < count, np.nan, 1000.0 + np.arange(of)))


@pytest.mark.parametrize(
    ("before", "after", "better", "says"),
    [
        (0, 0, True, "on 64 held-out rollouts of 64 parameter draws, gain at least"),
        (0, 1, False, "on 63 of 64 held-out rollouts of 63 parameter draws"),
        (1, 1, True, "1 diverged under the new policy and 1 under the other"),
        (6, 0, True, "0 diverged under the new policy and 6 under the other"),
        (7, 0, False, "0 diverged under the new policy and 7 under the other, which leaves too few"),
    ],
)
def test_who_diverges_more_or_leaves_too_few_pairs_is_not_better(
    before: int, after: int, better: bool, says: str
) -> None:
    rival = diverging(before)
    rival = dataclasses.replace(rival, returns=rival.returns - 900.0)
    found = compare_paired(rival, diverging(after))
    assert found.low is not None and found.low > 0 and found.better is better
    assert says in found.statement()


def test_of_eight_rollouts_none_may_be_lost() -> None:
    rival = outcomes(np.zeros(8))
    assert compare_paired(rival, diverging(0, 8)).better
    assert not compare_paired(outcomes(diverging(1, 8).returns - 900.0), diverging(0, 8)).better


@pytest.mark.parametrize("lost", [63, 64])
def test_a_comparison_of_which_nothing_is_left_says_so_in_plain_json(lost: int) -> None:
    found = compare_paired(diverging(0), diverging(lost))
    assert not found.better and found.low is None
    assert f"on {64 - lost} of 64 held-out rollouts" in found.statement() and "too few to tell" in found.statement()
    assert "nan" not in found.statement() and "inf" not in found.statement()
    told = strict_json(dataclasses.asdict(found) | {"statement": found.statement()})
    assert "NaN" not in told and "Infinity" not in told
    assert diverging(64).summary()["diverged"] == 64  # without a warning


def test_repeated_parameter_vectors_are_called_better_in_a_twentieth_of_cases_at_most() -> None:
    """2000 draws at 5 %: a count above 145 has a probability below 1e-5; by the pairs alone it would be some 700."""
    rng = np.random.default_rng(2)
    vectors = np.repeat(np.arange(6), [16, 8, 10, 10, 10, 10])
    none = outcomes(np.zeros(64))
    gains = (rng.normal(size=6)[vectors] + rng.normal(0, 0.2, 64) for _ in range(2000))
    assert sum(compare_paired(none, outcomes(gain), vectors).better for gain in gains) < 145


def test_the_gain_and_its_bound_follow_from_the_means_of_the_vectors() -> None:
    """By hand: means 1, 2 and 3, of which each has a third of the rollouts; t of two degrees of freedom."""
    gains = np.array([0.0, 1.0, 3.0, 2.0, 2.0, 4.0])
    found = compare_paired(outcomes(np.zeros(6)), outcomes(gains), np.array([0, 1, 2, 0, 1, 2]) * 7)
    assert found.gain == pytest.approx(2.0) and found.vectors == 3
    spread = np.std([1.0, 1.5, 3.5], ddof=1)
    assert found.low == pytest.approx(2.0 - 2.919986 * spread / np.sqrt(3), abs=1e-5)
    assert "on 6 held-out rollouts of 3 parameter draws" in found.statement()


def test_of_a_model_that_is_sure_of_its_parameters_each_rollout_stands_for_itself() -> None:
    rng = np.random.default_rng(3)
    none, one = outcomes(np.zeros(64)), np.zeros(64, int)
    found = compare_paired(none, outcomes(rng.normal(50.0, 10.0, 64)), one)
    assert found.better and found.vectors == 1 and "of 1 parameter draw," in found.statement()
    assert sum(compare_paired(none, outcomes(rng.normal(size=64)), one).better for _ in range(2000)) < 145


def test_conditions_are_a_function_of_the_seed_and_a_walk_beats_standing() -> None:
    model = base_model("hexapod")
    conditions = draw_conditions(model, "forward", 3, seed=2)
    again = draw_conditions(model, "forward", 3, seed=2)
    np.testing.assert_array_equal(conditions.parameters, again.parameters)
    assert conditions.scenarios == again.scenarios
    stand, walk = (evaluate(Gait(name), model, conditions) for name in ("stand", "tripod"))
    assert walk.mean_return > stand.mean_return + 1000
    assert np.nanmax(np.abs(stand.distance)) < 0.02


def test_systematic_draws_take_each_vector_as_often_as_its_weight_says() -> None:
    base = base_model("hexapod")
    particles = base.particles[np.arange(40) % 10]
    weight = np.repeat([1.0, 2.0, 3.0, 4.0], 10)[np.argsort(np.arange(40) % 10, kind="stable")]
    model = base.with_particles(particles, np.log(weight / weight.sum()))
    drawn = draw_conditions(model, "balance", 64, seed=3, systematic=True)
    for vector in np.unique(particles, axis=0):
        wanted = 64 * model.weights[(particles == vector).all(axis=1)].sum()
        assert abs((drawn.parameters == vector).all(axis=1).sum() - wanted) < 1
    assert drawn.scenarios != draw_conditions(model, "balance", 64, seed=4, systematic=True).scenarios


def test_the_interval_of_the_mean_return_is_students_and_unknown_for_one_rollout() -> None:
    returns = np.array([1.0, 2.0, 3.0, np.nan])
    low, high = Evaluation(returns, returns, returns).interval()
    assert (low, high) == pytest.approx((2 - 4.303 / np.sqrt(3), 2 + 4.303 / np.sqrt(3)), abs=1e-3)
    assert np.isnan(Evaluation(returns[:1], returns[:1], returns[:1]).interval()).all()
