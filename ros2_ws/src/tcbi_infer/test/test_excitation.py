"""What to record next: motions on which models that these rollouts cannot tell apart would differ."""

import dataclasses

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_contract.names import JOINT_LIMIT, JOINTS
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import Diagnosis, diagnose, excitation
from tcbi_infer.diagnose.excitation import TELLING, advice, expected_ratio, planted
from tcbi_infer.diagnose.fit import Fitter, Nuisance
from tcbi_infer.diagnose.motions import ready_motions, standard_motions
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.settings import QUICK
from tcbi_infer.errors import InferError
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

TWINS = ("command_latency", "sensor_latency")
HEAVY = "rotor_inertia"


@pytest.fixture(scope="module")
def unsure() -> Diagnosis:
    """A late bench without body sensors, of which no motion tells where the delay sits."""
    truth = base_model("servo_bench").with_effect("command_latency")
    rollouts = [m for m in record(truth, np.r_[BASE, 0.06]) if m.policy_id in ("sine", "steps", "chirp", "saw")]
    return diagnose(base_model("servo_bench"), rollouts, uses=TWINS, settings=QUICK, show=[HEAVY])


def test_no_motion_is_said_to_tell_twins_apart(unsure):
    assert unsure.verdict == "cannot_tell"
    between = [m for m in unsure.next_motions if set(m.between) == set(TWINS)]
    assert between and max(m.nats for m in between) < TELLING
    assert any(line.startswith(f"None of {len(between)} ready motions tells") for line in advice(unsure.next_motions))


def test_a_rotors_inertia_shows_where_the_joint_accelerates(unsure):
    nats = {m.motion: m.nats for m in unsure.next_motions if m.between == (HEAVY, "")}
    assert min(nats["steps"], nats["reversals"]) > 3 * nats["sweep"]


def test_the_most_telling_motion_comes_first_with_the_commands_to_play(unsure):
    told = [m for m in unsure.next_motions if m.between == (HEAVY, "")]
    assert [m.nats for m in told] == sorted((m.nats for m in told), reverse=True)
    time, target = np.array(told[0].table).T
    assert not told[0].command and np.all(np.diff(time) > 0) and np.ptp(target) > 0.1
    assert unsure.to_json()["next_motions"][0]["table"]


@pytest.mark.parametrize(("lost", "told"), [((0, 1), 0.0), ((1,), np.inf)])
def test_a_probe_that_diverges_in_one_ready_motion_does_not_count_against_the_others(monkeypatch, lost, told):
    model = base_model("servo_bench")
    replay = Replay.of(model, record(model, BASE)[:4])
    problem = Problem.of(replay, replay.noise_floor(np.zeros_like(replay.measured)).values)
    fitter = Fitter(problem, model, Nuisance.none(problem), np.arange(2), 0.005)
    base = fitter.run(model.to_unit(BASE)[None], radii=(0.02,))
    truth = planted(base, HEAVY, None)
    motions = ready_motions(load_rig(model.rig), replay.measurements)[:3]
    whole = expected_ratio(problem, truth, base, motions, 0.005)
    predict = Fitter.predict

    def broken(self, unit):
        predicted = predict(self, unit)
        if len(predicted) > 1:
            predicted[list(lost), 1] = np.nan
        return predicted

    monkeypatch.setattr(Fitter, "predict", broken)
    found = expected_ratio(problem, truth, base, motions, 0.005)
    assert found[[0, 2]] == pytest.approx(whole[[0, 2]]) and whole.min() > 0.0
    assert found[1] <= told and (told == 0.0 or found[1] > 0.0)


def recorded(policy_id: str, rig: str = "hexapod", targets: np.ndarray | None = None) -> Measurement:
    joints = load_rig(rig).joint_names
    commands = Commands(np.arange(20) * 0.2, np.zeros((20, len(joints))) if targets is None else targets)
    scenario = Scenario("balance", 4.0, slope_roll=0.1)
    time = np.arange(1, 201) / 50
    return Measurement("r", rig, scenario, policy_id, "sim", commands, joints, (), time, np.zeros((200, len(joints))))


def test_a_walking_robot_is_offered_gaits_that_it_has_not_recorded():
    motions = ready_motions(load_rig("hexapod"), [recorded("gait:twist"), recorded("gait:steps")])
    names = {m.name for m in motions}
    assert {"gait:steps:1", "gait:dither", "gait:tripod"} <= names
    assert not {"gait:twist", "gait:steps", "gait:stand"} & names
    assert all("--slope-roll 0.1 " in m.command and m.scenario.slope_roll == 0.1 for m in motions)
    assert all(np.abs(m.commands.target).max() <= JOINT_LIMIT + 1e-9 for m in motions)
    assert all(m.commands.target.shape == (20, 18) and m.description for m in motions)


def test_a_bench_is_offered_plans_within_the_positions_and_speeds_that_it_has_seen():
    seen = 0.5 + 0.3 * np.sin(np.arange(20))[:, None]
    motions = ready_motions(load_rig("servo_bench"), [recorded("", "servo_bench", seen)])
    fastest = np.abs(np.diff(seen, axis=0)).max()
    for motion in motions:
        assert seen.min() <= motion.commands.target.min() and motion.commands.target.max() <= seen.max()
        assert np.abs(np.diff(motion.commands.target, axis=0)).max() <= fastest
    assert len({m.name for m in motions}) == len(motions) >= 5


def test_a_rig_driven_by_torque_starts_where_it_was_and_one_that_was_let_go_is_offered_nothing():
    rig = load_rig("double_pendulum")
    torque = 0.4 * np.sin(np.arange(20))[:, None] * np.ones((1, 2))
    driven = recorded("", "double_pendulum", torque)
    start = dataclasses.replace(driven.scenario, initial_joint_position=(1.0, 0.5), initial_joint_velocity=(2.0, 0.0))
    motions = ready_motions(rig, [dataclasses.replace(driven, scenario=start)])
    assert motions and all(m.scenario.initial_joint_position == (1.0, 0.5) for m in motions)
    assert all(m.scenario.initial_joint_velocity is None for m in motions)
    assert ready_motions(rig, [recorded("", "double_pendulum")]) == []
    with pytest.raises(InferError, match="driven by torque"):
        standard_motions(rig, 3.0)


@pytest.mark.parametrize("rig", ["hexapod", "servo_bench"])
def test_without_recordings_there_are_five_kinds_of_motion_within_the_rigs_range(rig):
    motions = standard_motions(load_rig(rig), 3.0)
    limit = JOINT_LIMIT if load_rig(rig).joint_names == JOINTS else load_rig(rig).joint_range
    assert len({m.scenario.task for m in motions}) == 1 and len(motions) >= 5
    assert all(np.abs(m.commands.target).max() <= limit + 1e-9 and m.scenario.duration == 3.0 for m in motions)


@pytest.mark.parametrize(
    ("uses", "fits", "pairs"),
    [
        ("abcde", "abcde", [("a", "b"), ("a", "c"), ("a", "d")]),  # the best against three rivals at most
        ("ab", "abc", [("a", "b")]),
        ("a", "ab", [("a", "")]),
        ("", "bc", [("b", "")]),  # none named: the best one fitted, against the model without it
    ],
)
def test_the_best_is_to_be_told_from_each_of_its_rivals(monkeypatch, uses, fits, pairs):
    asked = []

    def told(problem, names, rivals, motions, timestep):
        asked.append((names, rivals))
        return (names,)

    monkeypatch.setattr(excitation, "next_motions", told)
    found = excitation.between(None, list(uses), "base", {use: f"fit of {use}" for use in fits}, ["a motion"], 0.005)
    assert list(found) == [names for names, _ in asked] == pairs
    assert all(fitted == (f"fit of {a}", f"fit of {b}" if b else "base") for (a, b), fitted in asked)


def test_a_bench_that_was_commanded_slowly_gets_motions_with_commands():
    slow = [
        dataclasses.replace(m, commands=Commands(np.arange(5) * 20.0, np.linspace(-0.5, 0.5, 5)[:, None]))
        for m in record(base_model("servo_bench"), BASE)[:2]
    ]
    ready = ready_motions(load_rig("servo_bench"), slow)
    assert ready and min(len(motion.commands.time) for motion in ready) >= 20
