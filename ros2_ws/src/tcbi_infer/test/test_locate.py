"""Errors planted in a prediction are found where they were put, with their kind and size."""

import dataclasses

import numpy as np
import pytest
from legged_cases import walk
from pendulum_cases import MODEL as PENDULUM
from pendulum_cases import TIMES, swing

from tcbi_infer.compare.conditions import MOVING, REVERSAL, STANCE, STILL, SWING, conditions, phases
from tcbi_infer.compare.kinds import UNDER_LOAD, kind_of
from tcbi_infer.compare.locate import locate, worst_moments
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import DEGREE, JOINT, reference
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

RIG, MODEL = load_rig("hexapod"), base_model("hexapod")
T = np.arange(400) / 50.0
POSITION = 15 * np.sin(2 * np.pi * np.array([[0.5], [0.8]]) * T)
VELOCITY = np.gradient(POSITION, T, axis=1)
ASKED = POSITION + 2.0 * np.sin(2 * np.pi * 0.11 * T + 1)
NOISE = np.random.default_rng(0).normal(0, 0.05, POSITION.shape)


@pytest.mark.parametrize(
    ("error", "kind", "size", "words"),
    [
        (-0.06 * VELOCITY, "lag", 0.06, "lags the prediction by 60 ms"),
        (0.03 * VELOCITY, "lag", -0.03, "leads the prediction by 30 ms"),
        (np.full_like(POSITION, -1.2), "offset", -1.2, "reads 1.2 deg less than predicted"),
        (-0.1 * POSITION, "gain", -0.1, "moves 10 % too little"),
        (-2.0 * POSITION, "gain", -2.0, "moves against the prediction"),
        (0.4 * (POSITION - ASKED), "droop", 0.4, "gives way under load 40 % more than predicted"),
        (-0.8 * np.sign(VELOCITY), "hysteresis", 0.8, "trails by 0.8 deg whichever way it moves"),
        (20 * NOISE, "scatter", 1.05, "scatters by 1.1 deg about the prediction"),
        (
            np.array([[1.5], [-1.5]]) + 0 * POSITION,
            "offset",
            1.5,
            "reads 1.5 deg more or less than predicted, each its own way",
        ),
    ],
)
def test_a_kind_of_error_is_told_with_its_size(error, kind, size, words):
    found = kind_of(error + NOISE, POSITION, VELOCITY, ASKED)
    assert found.name == kind and found.size == pytest.approx(size, rel=0.15)
    assert found.words(plural=False) == words


@pytest.fixture(scope="module")
def replay():
    return Replay.of(MODEL, walk(repeats=1))


def located(replay, plant, seed=0):
    """What is found where `plant` has changed the joints' (R, T, J) measured angles in deg."""
    joints = replay.layout.where(JOINT)
    rng = np.random.default_rng(seed)
    predicted = replay.measured.copy()
    measured = predicted + rng.normal(0, 0.05, predicted.shape)
    measured[..., joints] += plant(predicted[..., joints])
    floor = np.full(predicted.shape[-1], 0.05)
    rig = load_rig(replay.rig)
    return locate(rig, replay.layout, replay.measurements, replay.time, measured - predicted, predicted, floor)


def late(replay, joints, seconds, mask=True):
    def plant(angles):
        change = np.zeros_like(angles)
        change[..., joints] = -seconds * np.gradient(angles, replay.time, axis=1)[..., joints]
        return change * mask

    return plant


def test_nothing_is_found_where_the_model_is_right(replay):
    assert located(replay, np.zeros_like) == []


def test_one_joint_that_lags_is_named_first_with_its_lag(replay):
    first = located(replay, late(replay, [RIG.index("rm_tibia")], 0.08))[0]
    assert first.channels == ("rm_tibia",) and first.kind == "lag"
    assert first.statement.startswith("rm_tibia lags the prediction by 8") or "by 79 ms" in first.statement


def test_a_group_is_named_in_the_phase_in_which_it_lags(replay):
    group = RIG.groups["femurs of the middle legs"]
    joints = [RIG.index(j) for j in group]
    swing = np.stack([phases(RIG, m, replay.time)[SWING] for m in replay.measurements])
    assert swing[..., joints].sum() > 30, "the motion lifts its middle legs"
    first = located(replay, late(replay, joints, 0.06, swing))[0]
    assert first.channels == group and first.phase == SWING
    assert "femurs of the middle legs lag the prediction by 6" in first.statement


def test_findings_do_not_repeat_each_other(replay):
    plant_knee = late(replay, [RIG.index("lf_tibia")], 0.1)
    hip = RIG.index("rr_coxa")

    def both(angles):
        change = plant_knee(angles)
        change[..., hip] += 1.0
        return change

    found = located(replay, both)
    assert [f.channels for f in found[:2]] in ([("lf_tibia",), ("rr_coxa",)], [("rr_coxa",), ("lf_tibia",)])
    assert {f.kind for f in found[:2]} == {"lag", "offset"}


def test_the_moment_of_a_finding_lies_in_its_phase(replay):
    joints = [RIG.index(j) for j in RIG.groups["femurs"]]
    mask = np.stack([phases(RIG, m, replay.time)[REVERSAL] for m in replay.measurements])
    first = located(replay, lambda q: 2.0 * mask * np.isin(np.arange(18), joints))[0]
    assert first.phase == REVERSAL and first.moment.inside.any()
    assert first.moment.channel in joints


def test_phases_cover_every_sample_once_but_for_contacts(replay):
    found = phases(RIG, replay.measurements[0], replay.time)
    assert np.all(sum(found[p].astype(int) for p in (REVERSAL, STILL, "while moving")) == 1)
    assert np.all(found[STANCE] ^ found[SWING])


def test_only_conditions_that_vary_are_looked_at(replay):
    def names(measurements):
        return {c.name for c in conditions(replay.layout, measurements, replay.time, replay.measured)}

    flat = [
        dataclasses.replace(m, scenario=dataclasses.replace(m.scenario, slope_roll=0.0)) for m in replay.measurements
    ]
    assert "slope" in names(replay.measurements) and "slope" not in names(flat)
    volts = [
        dataclasses.replace(m, scenario=dataclasses.replace(m.scenario, constants=(("vin", 7.0 + k),)))
        for k, m in enumerate(flat)
    ]
    assert "vin" in names(volts)


def test_the_load_of_a_joint_is_how_far_the_models_servo_gives_way(replay):
    asked = np.stack([reference(m, replay.time) for m in replay.measurements]) * DEGREE
    joints = replay.layout.where(JOINT)
    predicted = replay.measured.copy()
    predicted[..., joints] = asked - 3.0
    found = conditions(replay.layout, replay.measurements, replay.time, predicted)
    assert all("load" not in c.name for c in found), "a load that never varies tells nothing"
    predicted[:, 50, joints[4]] -= 2.0
    load = conditions(replay.layout, replay.measurements, replay.time, predicted)[0]
    assert load.values[0, 50, 4] == pytest.approx(5.0) and load.values[0, 51, 4] == pytest.approx(3.0)


def test_ten_worst_moments_are_apart(replay):
    rng = np.random.default_rng(0)
    residual = rng.normal(0, 1, replay.measured.shape)
    found = worst_moments(residual, np.ones(residual.shape[-1]), replay.layout.where(JOINT), 10, 20)
    apart = found[: len(residual)]  # as many as any rollouts have
    assert len(found) == 10 and len({(r, t) for r, t, _ in apart}) == len(apart)
    for a in apart:
        assert all(a is b or a[0] != b[0] or abs(a[1] - b[1]) >= 20 for b in apart)


def test_short_rollouts_have_ten_worst_moments_too_of_several_joints():
    residual = np.random.default_rng(0).normal(0, 1, (1, 60, 18))
    found = worst_moments(residual, np.ones(18), np.arange(18), 10, 40)
    assert len(set(found)) == 10 and len({c for _, _, c in found}) == 10


@pytest.fixture(scope="module")
def driven():
    """A rig whose commands are torques."""
    return Replay.of(PENDULUM, swing(repeats=1))


def test_the_phases_of_a_rig_driven_by_torque_are_those_of_its_predicted_motion(driven):
    turn = driven.time[:, None] * np.array([0.0, 2 * np.pi])
    found = phases(load_rig(driven.rig), driven.measurements[0], driven.time, 0.5 * np.cos(turn))
    assert found[STILL][:, 0].all() and found[STILL][:, 1].mean() < 0.1
    just_after = np.isclose(driven.time % 0.5, 0.05, atol=0.02) & (driven.time > 0.5)
    assert found[REVERSAL][just_after, 1].all() and found[MOVING][:, 1].mean() > 0.5


def test_the_load_of_a_rig_driven_by_torque_is_its_torque(driven):
    load, *others = conditions(driven.layout, driven.measurements, driven.time, driven.measured)
    assert load.unit == "N m" and {c.name for c in others} == {"time since start"}
    assert not load.values[:, driven.time < TIMES[0]].any(), "nothing is asked for before the first command"
    inside = np.searchsorted(driven.time, TIMES + 0.1)
    asked = np.abs([m.commands.target for m in driven.measurements])
    np.testing.assert_allclose(load.values[:, inside], asked, atol=1e-9)


def test_an_error_under_torque_is_found_there_and_nothing_droops(driven):
    load = conditions(driven.layout, driven.measurements, driven.time, driven.measured)[0]
    first = located(driven, lambda q: 3.0 * load.upper() * (np.arange(2) == 1))[0]
    assert first.channels == ("elbow",) and first.phase == UNDER_LOAD and first.kind == "offset"
    asked = np.stack([reference(m, driven.time) for m in driven.measurements]) * DEGREE
    assert all(f.kind != "droop" for f in located(driven, lambda q: 0.1 * (q - asked)))
