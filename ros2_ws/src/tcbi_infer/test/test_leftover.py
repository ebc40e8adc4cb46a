"""What of a planted residual goes with what was recorded: the right variable is named, and noise explains nothing."""

import dataclasses

import numpy as np
import pytest
from bench_recordings import BASE, NOISE, record
from pendulum_cases import MODEL as PENDULUM
from pendulum_cases import VALUES, swing

from tcbi_infer.compare.conditions import torques
from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import DEGREE, reference
from tcbi_infer.diagnose.evidence import Variable
from tcbi_infer.diagnose.leftover import COMMAND, LOAD, OFFSET, POSITION, TORQUE, _statement, explain
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model

MODEL = base_model("servo_bench")
SIZE = 1.0  # deg, of what is planted


@pytest.fixture(scope="module")
def problem() -> Problem:
    """The bench's recordings."""
    return at_truth(MODEL, BASE, record(MODEL, BASE))


def at_truth(model: Model, values: np.ndarray, recordings: list[Measurement]) -> Problem:
    """Predicted at the truth, so that a residual is what a test plants."""
    replay = Replay.of(model, recordings)
    predicted = replay.predict(model, values[None])[0]
    residual = replay.measured - replay.by_rollout(predicted)
    floor = noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    return dataclasses.replace(Problem.of(replay, floor.values), observed=predicted)


def told(problem: Problem, planted: np.ndarray, seed: int = 0, kinds: int = 7):
    """What is said of a planted residual (S, T) in degrees, with noise as of two recordings."""
    sets = np.arange(len(problem.observed))[:kinds]
    noise = np.random.default_rng(seed).normal(0, NOISE * DEGREE / np.sqrt(2), planted.shape)
    residual = (planted + noise)[..., None]
    shifted = dataclasses.replace(problem, observed=problem.observed + residual)
    return explain(shifted.with_autocorrelation(residual), residual[sets], sets)


def position(problem: Problem) -> np.ndarray:
    return problem.observed[..., 0]


def velocity(problem: Problem) -> np.ndarray:
    return np.gradient(position(problem), problem.replay.time, axis=1)


def shares(found) -> dict[str, float]:
    return {v.name: v.share for v in found.variables}


def test_a_torque_that_comes_and_goes_with_the_position_is_named(problem):
    found = told(problem, SIZE * np.sin(position(problem) * 2 * np.pi / 12.0))
    assert found.variables[0].name == POSITION and found.variables[0].share > 0.8
    assert shares(found)["the predicted velocity"] < 0.3
    assert f"{100 * found.share:.0f} % of the joints" in found.statement and f"{POSITION} alone" in found.statement


def test_what_two_variables_share_only_both_explain(problem):
    turning = np.sign(velocity(problem))
    found = told(problem, SIZE * (1.5 * np.sin(position(problem) * 2 * np.pi / 40.0) + turning))
    alone = shares(found)
    assert max(alone.values()) < 0.65 and found.share > 0.85
    assert {v.name for v in found.variables if v.sure} >= {POSITION, "the direction of motion"}


def test_rubbing_against_the_direction_of_motion_is_named(problem):
    found = told(problem, -SIZE * np.sign(velocity(problem)))
    assert found.variables[0].name == "the direction of motion" and found.variables[0].share > 0.8
    assert shares(found)[OFFSET] < 0.2


def test_an_offset_is_no_law_of_the_variables(problem):
    found = told(problem, np.full(position(problem).shape, SIZE))
    assert found.variables[0].name == OFFSET and found.variables[0].share > 0.9
    assert max(v.share for v in found.variables[1:]) < 0.1


def test_what_gives_way_under_load_is_named(problem):
    firsts = [problem.replay.measurements[g.members[0]] for g in problem.replay.replicates]
    asked = np.stack([reference(m, problem.replay.time)[:, 0] for m in firsts]) * DEGREE
    load = asked - position(problem)
    found = told(problem, SIZE * np.clip(load / 5.0, -1, 1) * np.abs(load / 5.0))
    assert shares(found)[LOAD] > 0.8 and found.share > 0.8


@pytest.mark.parametrize("seed", range(6))
def test_an_error_that_goes_with_nothing_recorded_is_said_to_be_so(problem, seed):
    rng = np.random.default_rng(seed)
    white = rng.normal(size=position(problem).shape)
    smooth = np.apply_along_axis(lambda row: np.convolve(row, np.ones(15) / 15, "same"), 1, white)
    found = told(problem, SIZE * smooth / smooth.std(), seed)
    assert found.share == 0.0 and not any(v.sure for v in found.variables)
    assert found.statement.startswith("Nothing recorded explains it") and POSITION in found.statement


def test_at_the_noise_floor_nothing_is_left_to_explain(problem):
    found = told(problem, np.zeros(position(problem).shape))
    assert found.share == 0.0 and "nothing is left to explain" in found.statement


def test_two_kinds_of_motion_tell_nothing(problem):
    found = told(problem, SIZE * np.sign(velocity(problem)), kinds=2)
    assert found.share is None and "2 kinds of motion" in found.statement


def test_a_rig_driven_by_torque_has_no_commanded_position_and_its_torque_is_named():
    problem = at_truth(PENDULUM, VALUES, swing())
    firsts = [problem.replay.measurements[g.members[0]] for g in problem.replay.replicates]
    torque = np.stack([torques(m, problem.replay.time) for m in firsts])
    noise = np.random.default_rng(0).normal(0, NOISE * DEGREE / np.sqrt(2), torque.shape)
    residual = SIZE * torque * np.abs(torque) + noise
    shifted = dataclasses.replace(problem, observed=problem.observed + residual)
    found = explain(shifted.with_autocorrelation(residual), residual, np.arange(len(firsts)))
    assert found.variables[0].name == TORQUE and found.variables[0].share > 0.8
    assert not {COMMAND, LOAD, "the commanded speed"} & set(shares(found))


def test_what_grows_with_a_temperature_is_named_though_one_recording_has_none(problem):
    replay = problem.replay
    names = list(dict.fromkeys(m.policy_id for m in replay.measurements))
    seconds = np.arange(6.0)
    degrees = {name: 40.0 + 5.0 * np.sin(seconds + 2.0 * i) for i, name in enumerate(names)}
    measured = tuple(
        dataclasses.replace(
            m, readings={"temperature_C": (seconds, degrees[m.policy_id])} if m.policy_id != "saw" else {}
        )
        for m in replay.measurements
    )
    warm = dataclasses.replace(problem, replay=dataclasses.replace(replay, measurements=measured))
    error = 0.2 * SIZE * np.stack([np.interp(replay.time, seconds, degrees[name]) - 40.0 for name in names])
    found = told(warm, error)
    assert found.variables[0].name == "the measured temperature" and found.variables[0].sure
    assert shares(found)["the measured temperature"] > 0.6 and "the measured voltage" not in shares(found)
    assert told(problem, error).share < 0.2


def test_the_variable_named_is_the_first_of_which_the_motions_agree():
    doubtful, sure = (Variable(name, share, 0.1, name == LOAD) for name, share in ((POSITION, 0.5), (LOAD, 0.3)))
    assert _statement(0.6, [doubtful, sure]).endswith(f"{LOAD} alone 30 %.")
    assert _statement(0.6, [doubtful]).endswith("no single variable does.")
