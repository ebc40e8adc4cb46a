"""What a method sees of particles does not depend on who simulates them, nor with how many others."""

from typing import Any

import numpy as np
import pytest
from tcbi_cases import bench_rollouts

from tcbi_infer.baselines.trajectory import trajectories
from tcbi_infer.tcbi.problem import Problem, task_features
from tcbi_policy.artefact import find_policy
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.workers import Here, using

VIEWS = {"statistics": task_features, "trajectories": trajectories}


class Several(Here):
    """As many at a time as a cluster, but here."""

    def __init__(self, processors: int):
        super().__init__(1, processors)


def balancing(duration: float = 1.0) -> Problem:
    """A policy that reacts to what it sees, on three slopes."""
    model, policy = base_model("hexapod"), find_policy("balance")
    scenarios = [Scenario("balance", duration, 0.1 * s, -0.08 * s, seed=s) for s in range(3)]
    out = simulate(model, model.mean()[None], scenarios, controller=policy, timestep=0.01)
    measured = [out.measurement(0, s, f"slope_{s}", policy.policy_id) for s in range(3)]
    return Problem.of(model, measured, loop="closed", timestep=0.01)


def equal(part: Any, other: Any) -> bool:
    """An array, or several."""
    if isinstance(part, tuple):
        return all(map(equal, part, other))
    return np.array_equal(part, other, equal_nan=part.dtype != bool)


@pytest.fixture(scope="module", params=["open loop", "closed loop"])
def problem(request: pytest.FixtureRequest) -> Problem:
    return Problem.of(*bench_rollouts(count=4), timestep=0.01) if request.param == "open loop" else balancing()


@pytest.mark.parametrize("view", VIEWS)
def test_however_many_work_every_view_has_the_bits_of_one(problem: Problem, view: str, monkeypatch) -> None:
    monkeypatch.setattr("tcbi_sim.workers.LEAST_STEPS", 1)
    unit, told = np.random.default_rng(0).random((7, len(problem.model.names))), []
    alone = problem.simulate(unit, view=VIEWS[view])
    with using(Several(1)):
        one_thread = problem.simulate(unit, view=VIEWS[view])
    with using(Several(3)):
        shared = problem.simulate(unit, told.append, VIEWS[view])
    assert len(told) == 7 and told[-1] == 1.0
    for name, *values in zip(alone._fields, alone, one_thread, shared, strict=True):
        assert all(equal(v, values[0]) for v in values), name


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("duration", [1.02, 1.08, 1.16])
def test_recordings_that_end_between_two_ticks_are_simulated_in_closed_loop_to_their_end(duration: float, view) -> None:
    problem = balancing(duration)
    (group,) = problem.groups
    assert len(group.time) == round(50 * duration) + 1
    seen = problem.simulate(problem.model.to_unit(problem.model.mean()[None]), view=VIEWS[view])
    assert seen.valid.all()
    (rollouts,) = problem.rollouts(problem.model.to_unit(problem.model.mean()[None])).readings
    apart = rollouts.joint_position[0] - group.arrays.joint_position[0]
    assert np.abs(apart).max() < 0.02, "the same robot on the same slopes, but for the sensors' noise"
