"""Rollouts of two robots are told from those of one."""

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer.tcbi.mixed import groups, mixed
from tcbi_infer.tcbi.predictive import departures
from tcbi_infer.tcbi.problem import Problem
from tcbi_sim.model import base_model

BENCH = base_model("servo_bench")
OTHER = tuple(v + 0.2 if v < 0.5 else v - 0.2 for v in BENCH_TRUTH)


@pytest.mark.parametrize("count", [6, 12, 40])
def test_values_about_one_place_hardly_ever_fall_into_two_groups(count: int) -> None:
    rng = np.random.default_rng(count)
    assert sum(groups(rng.normal(0.5, 0.1, (count, 3))) is not None for _ in range(200)) <= 2


def test_values_about_two_places_do_whatever_their_order_and_their_shares() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0.5, 0.03, (20, 3))
    high = [2, 3, 5, 11, 17]
    values[high, 1] += 0.3
    found = groups(values)
    assert found is not None and found.parameter == 1 and found.high == tuple(high)
    assert len(found.low) == 15


def test_nothing_is_said_of_few_rollouts_of_one_that_is_unlike_or_of_groups_close_to_each_other() -> None:
    values = np.random.default_rng(0).normal(0.5, 0.001, (20, 2))
    alone, close, unknown = values.copy(), values.copy(), values.copy()
    alone[3, 0] += 0.3
    close[:10, 0] += 0.02
    unknown[4, 1] = np.nan
    for each in (alone, close, unknown, np.array([[0.1], [0.1], [0.9], [0.9]]), np.zeros((0, 3)), np.ones((9, 2))):
        assert groups(each) is None


def test_the_rollouts_of_two_servos_are_named_and_those_of_one_are_not() -> None:
    draws = np.clip(np.random.default_rng(0).normal(BENCH_TRUTH, 0.15, (48, len(BENCH_TRUTH))), 0.0, 1.0)
    one, other = bench_rollouts(seed=1)[1], bench_rollouts(OTHER, seed=2)[1]
    late = bench_rollouts((*BENCH_TRUTH, 0.6), effects=("command_latency",), seed=3)[1]
    for rollouts in ([*one, *bench_rollouts(seed=4)[1]], late):
        problem = Problem.of(BENCH, rollouts)
        assert mixed(BENCH.parameters, departures(problem, draws, np.zeros(48)).each, problem.rollout_ids) == []
    problem = Problem.of(BENCH, [*one[:5], *other])
    (line,) = mixed(BENCH.parameters, departures(problem, draws, np.zeros(48)).each, problem.rollout_ids)
    assert "steps_1_0, steps_1_1, steps_1_2 and 2 more move most like" in line and "the other 8 rollouts" in line
    assert mixed(BENCH.parameters, (), problem.rollout_ids) == []
