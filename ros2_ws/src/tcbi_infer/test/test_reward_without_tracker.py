"""Walking that nothing tracked: the operator's distance is enough for the reward statistic, measured and simulated."""

import dataclasses

import numpy as np
import pytest

from tcbi_infer.errors import InferError
from tcbi_infer.statistics import library, reward
from tcbi_infer.tcbi.channels import LEAST_SAMPLES
from tcbi_infer.tcbi.problem import Problem
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import Term, episode_reward, terms_of
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement, Scenario
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")
REWARD = {"statistics": ("reward",), "timestep": 0.01}


@pytest.fixture(scope="module")
def tracked() -> list[Measurement]:
    """Walks on different slopes, facing different ways: one more than a channel needs."""
    scenarios = [Scenario("forward", 2.0, slope_pitch=0.05 * k, initial_yaw=0.7 + k) for k in range(LEAST_SAMPLES + 1)]
    out = simulate(MODEL, MODEL.mean()[None], scenarios, controller=Gait("tripod"), timestep=0.01)
    return [out.measurement(0, s, f"walk{s}", "gait:tripod") for s in range(len(scenarios))]


def untracked(tracked: list[Measurement], *distances: float) -> list[Measurement]:
    return [
        dataclasses.replace(m, position=None, distance=d)
        for m, d in zip(tracked, distances or [m.distance for m in tracked], strict=True)
    ]


def test_the_reward_statistic_of_walking_needs_no_tracker(tracked: list[Measurement]) -> None:
    problem = Problem.of(MODEL, untracked(tracked), **REWARD)
    returns = [episode_reward(m).total / len(m.commands.time) for m in tracked]
    assert np.sort(problem.real_samples[0]) == pytest.approx(np.sort(returns))
    simulated = problem.rollouts(MODEL.to_unit(MODEL.mean()[None]))
    (rollouts,) = simulated.readings
    assert simulated.valid.all() and rollouts.position is None
    again = library()["reward"].compute(rollouts)[0, :, 0, 0]
    assert again == pytest.approx(returns, abs=1.0)  # less the sensors' noise


def test_one_distance_forgotten_costs_that_rollout_alone_and_all_forgotten_are_named(
    tracked: list[Measurement],
) -> None:
    problem = Problem.of(MODEL, untracked(tracked, np.nan, *[0.1] * LEAST_SAMPLES), **REWARD)
    assert len(problem.real_samples[0]) == LEAST_SAMPLES
    (rollouts,) = problem.rollouts(MODEL.to_unit(MODEL.mean()[None])).readings
    assert np.isfinite(library()["reward"].compute(rollouts)).sum() == LEAST_SAMPLES
    with pytest.raises(InferError, match="neither a position nor a distance at the end"):
        Problem.of(MODEL, untracked(tracked, *[np.nan] * len(tracked)), **REWARD)


def test_a_distance_counts_only_for_the_motion_that_made_it(tracked: list[Measurement]) -> None:
    """A rollout that is cut to the length of another has come another distance by then."""
    *others, last = untracked(tracked)
    shorter = dataclasses.replace(last, scenario=dataclasses.replace(last.scenario, duration=1.76))
    problem = Problem.of(MODEL, [*others, shorter], statistics=("reward", "attitude"), timestep=0.01)
    assert len(problem.groups) == 1
    assert np.isnan(problem.groups[0].arrays.distance).tolist() == [[True] * len(others) + [False]]


def test_a_reward_of_ones_own_that_is_made_of_a_position_says_that_it_lacks_one(
    tracked: list[Measurement], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = Term("pace", 1.0, "m/s", "progress by time", lambda steps: np.diff(steps.progress, axis=-1) / 0.2)
    monkeypatch.setattr(reward, "terms_of", lambda task: (*terms_of(task), own))
    with pytest.raises(InferError, match=r"a position, of which pace in the reward of this task is made"):
        Problem.of(MODEL, untracked(tracked), **REWARD)
