"""What to record next: the motion that shows what is unknown, not one that tells nothing; no promise against noise."""

import dataclasses
import shlex

import numpy as np
import pytest
from legged_cases import walk
from tcbi_cases import bench_rollouts, hexapod_rollouts

from tcbi_contract.names import SLOPE_LIMIT
from tcbi_infer.diagnose.motions import Motion
from tcbi_infer.report import Report, add_inference
from tcbi_infer.statistics import CALIBRATED
from tcbi_infer.tcbi.advice import (
    LEAST_ALPHA,
    REPEATS,
    Advice,
    advise,
    candidates,
    caution,
    directions,
    hindrance,
    residuals,
    unexplained,
)
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.method import METHODS
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import Result
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

TIMES = np.arange(0.0, 3.0, 0.4)
STILL = Motion("hold", "stays where it is", Scenario("hold", 3.0), Commands(TIMES, np.zeros((len(TIMES), 1))))
STEPS = Motion(
    "steps", "random steps", STILL.scenario, Commands(TIMES, np.random.default_rng(5).uniform(-1, 1, (len(TIMES), 1)))
)


def open_problem(measurements: list[Measurement]) -> tuple[Problem, Result]:
    """A problem, and the prior as its posterior: every parameter is open."""
    problem = Problem.of(bench_rollouts(count=2)[0], measurements, timestep=0.01)
    return problem, infer(problem, "prior")


@pytest.fixture(scope="module")
def bench() -> tuple[Problem, Result]:
    return open_problem(bench_rollouts(count=4)[1])


def test_the_share_left_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((400, 5))
    value = features[:, 0] + features[:, 1]
    assert unexplained(features, value) < 0.01
    assert unexplained(features, value + np.sqrt(2) * rng.standard_normal(400)) == pytest.approx(0.5, abs=0.1)
    assert unexplained(rng.standard_normal((60, 90)), value[:60]) > 0.85
    assert unexplained(np.ones((60, 3)), value[:60]) == 1.0


def test_a_motion_with_steps_is_advised_before_one_that_holds_still(bench: tuple[Problem, Result]) -> None:
    told: list[tuple[float, str]] = []
    advice = advise(*bench, lambda share, motion: told.append((share, motion)), motions=[STILL, STEPS])
    assert [a.parameter for a in advice] == list(bench[0].model.names)
    gain = advice[0]
    assert (gain.motion, gain.tells) == ("steps", True) and gain.left < 0.3
    assert told == [(0.0, "hold"), (0.5, "steps"), (1.0, "")]
    alone = advise(*bench, motions=[STILL])
    assert not any(a.tells for a in alone) and alone[0].left > 0.8


def test_a_motion_tells_more_in_time_than_by_its_distributions() -> None:
    """Of four searches that are known, what three parameters keep in all falls from 1.0 to 1.8 to 0.4 to 1.0."""
    model, measurements = bench_rollouts(count=4)
    distributions = tuple(name for name in CALIBRATED if not name.endswith("_motion"))
    alone, both = (Problem.of(model, measurements, statistics=s, timestep=0.01) for s in (distributions, CALIBRATED))
    assert [s.name for s in both.followed] == ["joint_motion"] and not alone.followed
    left = np.zeros(2)
    for seed in range(3):
        result = infer(alone, "calibrated", particles=30, generations=4, seed=seed)
        unsure = tuple(dataclasses.replace(e, identified=False) for e in result.estimates)
        result = dataclasses.replace(result, estimates=unsure, fits=True, ess=20.0)
        left += [sum(a.left for a in advise(p, result, motions=[STEPS])) for p in (alone, both)]
    assert left[1] < 0.85 * left[0]


def test_only_directions_beyond_the_noise_are_looked_along_and_these_get_as_much_noise() -> None:
    rng, line = np.random.default_rng(0), np.random.default_rng(1).standard_normal((2, 50))
    line /= np.linalg.norm(line)
    size = rng.standard_normal((4000, 1, 1))
    told = directions(0.3 * 5 * size * line, 0.3, rng)
    assert told.shape == (4000, 1) and told.var() == pytest.approx(25 + 1 / REPEATS, rel=0.1)
    assert abs(np.corrcoef(told[:, 0], size[:, 0, 0])[0, 1]) == pytest.approx(5 / np.sqrt(25 + 1 / REPEATS), abs=0.01)
    assert directions(0.3 * 0.1 * size * line, 0.3, rng).shape == (4000, 0)


def test_where_a_policy_acts_and_nothing_is_compared_in_time_distributions_are_looked_at_alone() -> None:
    walking = hexapod_rollouts("balance", count=2)
    problem = Problem.of(base_model("hexapod"), walking, loop="acting", timestep=0.01)
    assert not problem.followed
    twist = [motion for motion in candidates(problem) if motion.name == "gait:twist"][:1]
    advice = advise(problem, infer(problem, "prior"), motions=twist)
    assert [a.parameter for a in advice] == list(problem.model.names) and all(0 < a.left <= 1 for a in advice)


def test_where_rollouts_contradict_each_other_the_noise_is_largest(bench: tuple[Problem, Result]) -> None:
    problem, result = bench
    weighed = [dataclasses.replace(result, generations=({"alpha_supported": alpha},)) for alpha in (0.0, 0.5)]
    sds = [residuals(problem, found).sd_in_time(problem, 3.0) for found in weighed]
    assert sds[0] == pytest.approx(np.sqrt(0.5 / LEAST_ALPHA) * sds[1])


def test_where_recordings_differ_from_their_simulations_less_is_promised(bench: tuple[Problem, Result]) -> None:
    """Every rollout of another robot: what the statistics vary by from one to the next drowns the parameters."""
    rng = np.random.default_rng(1)
    others = [bench_rollouts(tuple(rng.uniform(0.05, 0.95, 3)), count=4, seed=0)[1][i] for i in range(4)]
    ours, theirs = (advise(*given, motions=[STEPS]) for given in (bench, open_problem(others)))
    assert theirs[0].left > ours[0].left + 0.1


def test_nothing_is_advised_where_nothing_is_open_or_nothing_can_be_said(bench: tuple[Problem, Result]) -> None:
    problem, result = bench
    known = tuple(dataclasses.replace(e, identified=True) for e in result.estimates)
    assert advise(problem, dataclasses.replace(result, estimates=known), motions=[STEPS]) == ()
    assert hindrance(result) == ""
    untold = dataclasses.replace(result, fits=None)
    assert "too few particles or generations" in hindrance(untold) and "effect" not in hindrance(untold)
    for worse in (untold, dataclasses.replace(result, fits=False), dataclasses.replace(result, ess=4.0)):
        assert hindrance(worse) and advise(problem, worse, motions=[STEPS]) == ()
    (none, *_) = advise(problem, result, motions=[])
    assert not none.tells and "no motion could be tried" in none.line()


def test_where_particles_are_too_few_for_the_data_more_generations_come_first(bench: tuple[Problem, Result]) -> None:
    result = bench[1]
    for alpha, said in ((0.05, "weighed at 12% of what they support"), (0.19, "48%"), (0.2, ""), (0.4, "")):
        line = caution(dataclasses.replace(result, generations=({"alpha": alpha, "alpha_supported": 0.4},)))
        assert said in line and bool(line) == bool(said)
    assert caution(result) == "", "a method without alpha"


def test_a_legged_robot_is_sent_onto_steeper_slopes_by_a_command() -> None:
    problem = Problem.of(base_model("hexapod"), walk(), timestep=0.01)
    tried = candidates(problem)
    steep = [m for m in tried if "slope of" in m.description]
    assert steep and len(tried) > len(steep)
    assert all(0.1 < m.scenario.slope_pitch <= SLOPE_LIMIT for m in steep)
    assert not any(m.name == "gait:stand" for m in tried)
    words = shlex.split(steep[0].command)
    assert words[words.index("--slope-pitch") + 1] == f"{steep[0].scenario.slope_pitch:g}"


def test_advice_is_on_the_page_and_says_where_none_would_tell(bench: tuple[Problem, Result]) -> None:
    advice = [
        Advice("gain", 0.2, True, "gait:twist", "twists", "./tcbi collect --policy gait:twist"),
        Advice("friction", 0.9, False, "gait:squat", "squats", "./tcbi collect --policy gait:squat"),
    ]
    assert "would leave 20% of its variance\n  ./tcbi collect --policy gait:twist" in advice[0].line()
    assert "none of the motions that were tried would tell" in advice[1].line()
    report = Report("x")
    add_inference(report, bench[1], METHODS["prior"], advice=advice)
    assert "What to record next" in report.html() and "./tcbi collect --policy gait:twist" in report.html()
