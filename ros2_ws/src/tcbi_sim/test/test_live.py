"""The live simulation obeys, goes limp and repeats itself as a robot on the bus should."""

import dataclasses

import numpy as np
import pytest

from tcbi_contract.names import JOINTS
from tcbi_contract.safety import CommandRefused, Mode
from tcbi_sim.effects import including, library
from tcbi_sim.errors import SimError
from tcbi_sim.live import LiveSimulation
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.tasks import TASKS

BALANCE = TASKS["balance"].draw(np.random.default_rng(5), 5)
FLAT = Scenario("balance", 8.0)


@pytest.fixture(scope="module")
def model():
    return base_model("hexapod")


def record(live: LiveSimulation, windows: int = 10) -> np.ndarray:
    """(T, ...) all readings of a short episode with swinging commands."""
    readings = [live.reset(live.scenario)]
    for k in range(windows):
        live.command(0.2 * np.sin(k + np.arange(len(JOINTS))), 0.2)
        readings += live.advance(10)
    return np.array([np.concatenate([np.ravel(v) for v in vars(r).values()]) for r in readings])


def test_the_same_seed_gives_the_same_bits_whatever_went_before(model):
    live = LiveSimulation(model, BALANCE)
    first = record(live)
    live.reset(FLAT)
    live.advance(7)
    live.reset(BALANCE)
    assert np.array_equal(first, record(live))
    assert np.array_equal(first, record(LiveSimulation(model, BALANCE)))


def test_another_seed_gives_other_noise_on_the_same_physics(model):
    other = record(LiveSimulation(model, dataclasses.replace(BALANCE, seed=6)))
    same = record(LiveSimulation(model, BALANCE))
    assert not np.array_equal(same, other)
    quiet = [record(LiveSimulation(model, dataclasses.replace(BALANCE, seed=s), noise=False)) for s in (5, 6)]
    assert np.array_equal(*quiet)


def test_readings_lie_on_the_encoders_steps(model):
    live = LiveSimulation(model, BALANCE)
    steps = record(live)[:, : len(JOINTS)] / (2 * np.pi / 4096)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_a_drawn_robot_differs_from_the_mean_one_and_repeats_by_seed(model):
    mean = record(LiveSimulation(model, BALANCE, noise=False), 3)
    drawn = [record(LiveSimulation(model, BALANCE, noise=False, draw=True), 3) for _ in range(2)]
    assert np.array_equal(*drawn)
    assert not np.allclose(mean, drawn[0], atol=1e-3)


def test_silence_makes_the_robot_limp_after_two_control_periods(model):
    live = LiveSimulation(model, FLAT, noise=False)
    start = live.reset(FLAT)
    live.command([0.0] * len(JOINTS), 0.2)
    live.advance(20)
    assert live.safety.mode is Mode.ACTIVE
    live.advance(1)
    assert live.safety.mode is Mode.LIMP
    assert live.advance(60)[-1].position[2] < start.position[2] - 0.02


def test_a_limp_robot_rises_from_where_it_lies_and_slowly(model):
    live = LiveSimulation(model, FLAT, noise=False)
    lying = live.advance(60)[-1]
    move = live.command([0.0] * len(JOINTS), 0.2)
    assert move.arm
    np.testing.assert_allclose(move.start, lying.joint_position, atol=1e-9)
    before = lying.joint_position
    for _ in range(12):
        live.command([0.0] * len(JOINTS), 0.2)
        after = live.advance(10)[-1].joint_position
        assert np.abs(after - before).max() < 0.25
        before = after
    assert live.safety.mode is Mode.ACTIVE
    assert np.abs(before).max() < 0.1


def test_a_robot_that_is_armed_again_does_not_go_on_to_its_old_goal(model):
    late = model.with_effect("command_latency")
    live = LiveSimulation(late, FLAT, noise=False)
    live.reset(FLAT)
    live.command([0.3] * len(JOINTS), 0.2)
    lying = live.advance(60)[-1].joint_position
    assert live.safety.mode is Mode.LIMP and np.abs(lying - 0.3).max() > 0.1
    live.command(lying.tolist(), 0.2, later_s=0.015)
    for reading in live.advance(10):
        np.testing.assert_allclose(reading.joint_position, lying, atol=2e-3)


def test_refused_commands_count_until_the_next_reset(model):
    live = LiveSimulation(model, FLAT)
    live.refuse("too old")
    assert (live.refused, live.reason) == (1, "too old")
    live.reset(FLAT)
    assert (live.refused, live.reason) == (0, "")


def test_an_emergency_stop_ends_only_by_release_and_reset(model):
    live = LiveSimulation(model, FLAT)
    live.reset(FLAT)
    live.stop()
    zero = [0.0] * len(JOINTS)
    with pytest.raises(CommandRefused, match="emergency stop"):
        live.command(zero, 0.2)
    with pytest.raises(CommandRefused, match="release"):
        live.reset(FLAT)
    assert live.release()
    assert not live.release()
    with pytest.raises(CommandRefused, match="reset_episode"):
        live.command(zero, 0.2)
    live.reset(FLAT)
    live.command(zero, 0.2)


def test_a_reset_holds_its_posture_until_the_first_command(model):
    live = LiveSimulation(model, BALANCE, noise=False)
    first = live.reset(BALANCE)
    last = live.advance(100)[-1]
    np.testing.assert_allclose(last.joint_position, first.joint_position, atol=0.02)


def test_a_command_given_between_samples_acts_from_then(model):
    moved = []
    for later in (0.0, 0.015):
        live = LiveSimulation(model, FLAT, noise=False)
        live.reset(FLAT)
        live.command([0.3] * len(JOINTS), 0.2, later)
        moved.append(live.advance(2)[-1].joint_position[0])
    assert moved[0] > 2 * moved[1] > 0


def test_a_tracker_sees_the_body_and_not_what_the_robots_own_sensors_make_of_it(model):
    worn = model.with_effect("imu_tilt").with_effect("sensor_latency")
    seen = []
    for size in (0.0, 0.1):
        particles = np.array([[size if "." in p.name else p.nominal for p in worn.parameters]])
        drawn = dataclasses.replace(worn, particles=particles, log_weights=np.zeros(1))
        live = LiveSimulation(drawn, BALANCE, noise=False)
        readings = [live.reset(BALANCE)]
        live.command([0.3] * len(JOINTS), 0.2)
        seen.append(readings + live.advance(10) + live.advance(3))
    for true, told in zip(*seen, strict=True):
        np.testing.assert_allclose(told.facing, true.facing, atol=1e-12)
        np.testing.assert_allclose(told.position, true.position, atol=1e-12)
    assert abs(seen[1][-1].orientation - seen[1][-1].facing).max() > 0.04
    assert abs(seen[0][-1].orientation - seen[0][-1].facing).max() < 1e-12


def test_a_rig_that_is_no_walking_robot_is_refused():
    with pytest.raises(SimError, match="servo_bench"):
        LiveSimulation(base_model("servo_bench"), Scenario("bench", 1.0))


def test_a_model_that_fails_leaves_the_one_before_in_use(model):
    def fail(*_):
        raise ValueError("no such body")

    live = LiveSimulation(model, BALANCE)
    first = record(live)
    broken = dataclasses.replace(library()["payload"], name="broken", apply=fail)
    with including(broken), pytest.raises(SimError, match=r"effect 'broken': apply\(\) raised ValueError"):
        live.reset(FLAT, model.with_effect("broken"))
    assert (live.model, live.scenario) == (model, BALANCE)
    assert np.array_equal(first, record(live))
