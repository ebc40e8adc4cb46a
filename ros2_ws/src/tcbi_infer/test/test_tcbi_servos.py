"""Servos of one make that differ from one another, and what may remain of divergences for it."""

import numpy as np
import pytest
from tcbi_cases import bench_rollouts, hexapod_rollouts

from tcbi_infer.tcbi import servos
from tcbi_infer.tcbi.goodness import allowing, goodness_of_fit, in_doubt
from tcbi_infer.tcbi.method import Generation
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.servos import SETS, Scattered, scattered
from tcbi_sim.model import base_model
from tcbi_sim.parameter import Parameter

MASS = Parameter("mass", "kg", 0.5, 1.5, 1.0)


def said(generation: Generation) -> list[str]:
    unit, equal = np.linspace(0.3, 0.7, 40)[:, None], np.zeros(40)
    return goodness_of_fit((MASS,), unit, equal, ["tracking"], generation, generation).lines


@pytest.mark.parametrize("misfit, channel", [(5.0, 1.0), (1.0, 9.0)])
def test_a_model_is_called_wrong_for_no_more_than_its_servos_leave(misfit: float, channel: float) -> None:
    """By the mean of a statistic's channels, and by one of them."""
    notes = {"floor_noise": [1.0], "floor_misfit": [misfit], "misfit": {"tracking/knee": channel}}
    left = Generation(40.0, 0.5, np.zeros(1), {**notes, "best": np.full((5, 1), 0.5).tolist()})
    assert in_doubt(["tracking"], left) and len(said(left)) == 1
    little, much = (Scattered(np.array([s]), {"tracking/knee": s}, 13) for s in (0.3, 1.5))
    assert len(said(allowing(left, little))) == 1
    assert said(allowing(left, much)) == [] and not in_doubt(["tracking"], allowing(left, much))


def test_servos_leave_more_the_more_they_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    model = base_model("hexapod")
    problem = Problem.of(model, hexapod_rollouts("gait:tripod", count=8, duration=2.0), timestep=0.01)
    best, tracking = model.to_unit(model.mean()), problem.observed.statistics.index("joint_tracking")
    found = scattered(problem, best)
    assert found.particles == SETS + 1 and set(found.channels) == set(problem.observed.channels)
    monkeypatch.setattr(servos, "SCATTER", 0.0)
    alike = scattered(problem, best)
    assert alike.statistics[tracking] < 0.2 * found.statistics[tracking]


def test_one_joint_has_no_others_to_differ_from() -> None:
    model, rollouts = bench_rollouts(count=3)
    problem = Problem.of(model, rollouts, timestep=0.01)
    found = scattered(problem, np.full(len(model.names), 0.5))
    assert not found.statistics.any() and found.channels == {} and found.particles == 0
