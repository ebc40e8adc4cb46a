"""Whether the kinds of motion agree on a parameter: planted differences are told, ordinary errors are not."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import adopt
from tcbi_infer.diagnose.agreement import LEAST_KINDS, agreement, disagreeing
from tcbi_infer.diagnose.evidence import Agreement
from tcbi_infer.diagnose.fit import Fitter, Nuisance, to_unit
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")


def told(recordings: Sequence[Measurement]) -> dict[str, Agreement]:
    """What is said of each parameter after a fit to all recordings."""
    replay = Replay.of(MODEL, recordings)
    residual = replay.measured - replay.by_rollout(replay.predict(MODEL, BASE[None])[0])
    floor = noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    problem, sets = Problem.of(replay, floor.values), np.arange(len(replay.replicates))
    none = Nuisance.none(problem)
    first = Fitter(problem, MODEL, none, sets, 0.002).run(to_unit(MODEL, BASE)[None], steps=(0.03,))
    problem = problem.with_autocorrelation(first.residual)
    fit = Fitter(problem, MODEL, none, sets, 0.002).run(first.unit[None], steps=(0.03, 0.03))
    covariance = np.linalg.inv(fit.normal.sum(axis=0) + 1e-3 * np.eye(3))
    return {a.name: a for a in agreement(problem, fit, none, sets, covariance)}


def mixed(first: Sequence[Measurement], second: Sequence[Measurement]) -> list[Measurement]:
    """Every second kind of motion, both of its repeats, from the second robot."""
    return [(second if i // 2 % 2 else first)[i] for i in range(len(first))]


@pytest.fixture(scope="module")
def same() -> list[Measurement]:
    return record(MODEL, BASE)


def test_motions_of_one_robot_agree_and_each_holds_the_truth(same):
    found = told(same)
    assert all(a.agrees for a in found.values())
    for a, true in zip(found.values(), BASE, strict=True):
        assert len(a.kinds) == 7
        assert all(abs(k.value - true) < 2 * (k.high90 - k.low90) for k in a.kinds), a.name
    assert {k.kind for k in found["friction"].kinds} == {"sine", "fast", "steps", "ramp", "chirp", "walk", "saw"}


@pytest.mark.parametrize(("parameter", "factor"), [("friction", 3.0), ("gain", 1.5)])
def test_a_value_that_differs_between_motions_is_told_and_no_other(same, parameter, factor):
    other = BASE * np.where(np.array(MODEL.names) == parameter, factor, 1.0)
    found = told(mixed(same, record(MODEL, other)))
    assert [a.name for a in disagreeing(list(found.values()))] == [parameter]
    values = {k.kind: k.value for k in found[parameter].kinds}
    assert values["fast"] > 1.2 * values["sine"] and "no one value holds" in found[parameter].statement


def test_errors_that_have_nothing_to_do_with_a_parameter_are_no_disagreement(same):
    """Teeth that no parameter of the model could imitate, at three times the noise."""
    shifted = [
        dataclasses.replace(m, joint_position=m.joint_position + 0.005 * np.sin(36.0 * m.joint_position)) for m in same
    ]
    assert not disagreeing(list(told(shifted).values()))


def test_too_few_kinds_of_motion_tell_nothing(same):
    few = told(same[: 2 * (LEAST_KINDS - 1)])
    assert {a.agrees for a in few.values()} == {None} and not disagreeing(list(few.values()))


def diagnosis(agrees: bool | None, parameter: str = "backlash.gap") -> dict:
    """A diagnosis of backlash, as it is written, as far as offering a value takes it."""
    told = {"name": parameter, "agrees": agrees, "statement": f"{parameter}: the kinds of motion disagree."}
    return {
        "ranking": [{"use": "backlash", "parameters": [{"name": "backlash.gap"}]}],
        "agreement": {"backlash": [told]},
    }


def test_a_size_on_which_the_motions_disagree_is_not_offered():
    told = adopt.objection(diagnosis(False), "backlash")
    assert "backlash.gap: the kinds of motion disagree" in told and "--anyway" in told


@pytest.mark.parametrize("found", [diagnosis(True), diagnosis(None), diagnosis(False, "gain"), {"ranking": []}])
def test_what_agrees_or_is_not_known_or_is_of_the_base_model_is_offered(found):
    assert not adopt.objection(found, "backlash")
