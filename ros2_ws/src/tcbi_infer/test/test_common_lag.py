"""A lag of all signals against the prediction is a finding; one of joints alone, or of a few, is none."""

import dataclasses
import types

import numpy as np
import pytest
from legged_cases import walk

from tcbi_infer.compare.common_lag import common_lag, signal_lags, without_latency
from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import ATTITUDE, JOINT, RATE
from tcbi_infer.diagnose.diagnosis import _Run
from tcbi_infer.diagnose.fit import Fitter, Nuisance
from tcbi_infer.diagnose.heldout import held_out
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")


@pytest.fixture(scope="module")
def replay():
    return Replay.of(MODEL, walk())


def delayed(replay, by, channels=None):
    """The (R, T, C) signals `by` s late: all, or the channels given."""
    values = replay.measured.copy()
    for r, c in np.ndindex(len(values), values.shape[2]):
        if channels is None or c in channels:
            values[r, :, c] = np.interp(replay.time - by, replay.time, replay.measured[r, :, c])
    return values


def found(replay, measured):
    names = [m.rollout_id for m in replay.measurements]
    return common_lag(replay.layout, replay.time, measured, replay.measured, names)


@pytest.mark.parametrize("by", [0.03, 0.08, 0.2])
def test_a_lag_of_all_signals_is_told_with_its_size(replay, by):
    (sentence,) = found(replay, delayed(replay, by))
    assert f"come {1000 * by:.0f} ms later than predicted:" in sentence and "cannot tell which" in sentence


@pytest.mark.parametrize("by", [0.0, 0.02, -0.08])
def test_a_small_lag_or_a_lead_is_none(replay, by):
    assert found(replay, delayed(replay, by)) == []


@pytest.mark.parametrize("groups", [(JOINT,), (ATTITUDE, RATE)])
def test_joints_or_body_alone_are_no_common_lag(replay, groups):
    measured = delayed(replay, 0.08, set(replay.layout.where(*groups)))
    lags = signal_lags(replay.time, measured[0], replay.measured[0])
    assert np.nanmedian(lags[replay.layout.where(*groups)]) == pytest.approx(0.08, abs=0.006)
    assert found(replay, measured) == []


def test_body_and_joints_with_different_lags_do_not_agree(replay):
    both = delayed(replay, 0.06)
    joints = replay.layout.where(JOINT)
    both[..., joints] = delayed(replay, 0.1)[..., joints]
    assert found(replay, both) == []


def test_signals_that_were_not_measured_or_have_gaps_do_not_hide_it(replay):
    measured = delayed(replay, 0.08)
    measured[..., replay.layout.index("acceleration_x")] = np.nan
    measured[:, :8] = np.nan
    measured[1:, 90:] = np.nan
    assert len(found(replay, measured)) == 1


def test_rollouts_that_are_late_are_named_where_others_are_not(replay):
    measured = delayed(replay, 0.08)
    measured[3] = replay.measured[3]
    assert "(motion0_0, motion0_1, motion1_0)" in found(replay, measured)[0]
    measured[:3] = replay.measured[:3]
    assert found(replay, measured) == []
    measured[0] = delayed(replay, 0.08)[0]
    assert found(replay, measured) == [], "one of four"


def test_a_robot_without_an_imu_has_no_common_lag(replay):
    measured = delayed(replay, 0.08)
    measured[..., replay.layout.where(ATTITUDE, RATE)] = np.nan
    assert found(replay, measured) == []


def test_compare_says_it_of_stamps_that_are_all_late_and_of_nothing_else():
    clean = walk(repeats=1)
    late = [dataclasses.replace(m, time=m.time + 0.08) for m in clean]
    words = "All signals, joints and body alike, come 80 ms later than predicted"
    assert any(words in guard for guard in compare(MODEL, late, particles=0).guards)
    joints = [dataclasses.replace(m, joint_position=np.roll(m.joint_position, 4, axis=0)) for m in clean]
    for rollouts in (clean, joints):
        assert not any("later than predicted" in guard for guard in compare(MODEL, rollouts, particles=0).guards)


@pytest.mark.parametrize(("by", "count"), [(0.0, 0), (0.08, 1)])
def test_a_diagnosis_guards_against_it_on_held_out_motions(replay, by, count):
    """Though residuals of averaged signals are zero at all samples but one of an average."""
    sets = np.arange(len(replay.replicates))
    observed = np.stack([delayed(replay, by)[g.members[0]] for g in replay.replicates])
    said = np.stack([replay.measured[g.members[0]] for g in replay.replicates])
    problem = dataclasses.replace(Problem.of(replay, replay.layout.floor()), observed=observed)
    run = types.SimpleNamespace(problem=problem, replay=replay, sets=sets, measurements=replay.measurements)
    judged = types.SimpleNamespace(held=types.SimpleNamespace(residual=problem.residual(said), predicted=said))
    late = [g for g in _Run._guards(run, judged, {}) if "come 80 ms later than predicted" in g]
    assert len(late) == count


def test_what_is_predicted_of_held_out_motions_is_kept_at_every_sample(replay):
    problem, sets = Problem.of(replay, replay.layout.floor()), np.arange(len(replay.replicates))
    none, mean = Nuisance.none(problem), MODEL.mean()[None]
    fit = Fitter(problem, MODEL, none, sets, 0.005).run(MODEL.to_unit(mean), radii=())
    held = held_out(problem, fit, sets, 0.005)
    assert held.predicted == pytest.approx(replay.predict(MODEL, mean, timestep=0.005)[0], abs=1e-6)
    assert np.array_equal(problem.residual(held.predicted), held.residual)


@pytest.mark.parametrize("effect", ["command_latency", "sensor_latency"])
def test_a_diagnosis_says_that_a_latency_it_fitted_may_be_a_late_clock(effect):
    late = Replay.of(MODEL, [dataclasses.replace(m, time=m.time + 0.08) for m in walk(repeats=1)])
    sets = np.arange(len(late.replicates))
    observed = np.stack([late.measured[g.members[0]] for g in late.replicates])
    model = MODEL.with_effect(effect)
    fit = types.SimpleNamespace(model=model, parameters=np.append(MODEL.mean(), 0.08))
    nothing_left = types.SimpleNamespace(predicted=observed)
    run = types.SimpleNamespace(
        problem=types.SimpleNamespace(observed=observed),
        replay=late,
        sets=sets,
        measurements=late.measurements,
        settings=types.SimpleNamespace(timestep=0.002),
    )
    base, judged = types.SimpleNamespace(held=nothing_left), types.SimpleNamespace(fit=fit, held=nothing_left)
    assert not any("later than predicted" in g for g in _Run._guards(run, base, {}))
    words = f"come 80 ms later than predicted without {effect}: the sensors' clock is late"
    assert sum(words in g for g in _Run._guards(run, base, {effect: judged})) == 1


def test_only_latencies_are_left_out_of_a_model():
    assert without_latency(MODEL, MODEL.mean()) is None
    model = MODEL.with_effect("viscous_damping").with_effect("command_latency")
    values = model.mean()
    found = without_latency(model, values)
    assert found[-1] == 0.0 != values[-1] and np.array_equal(found[:-1], values[:-1])
