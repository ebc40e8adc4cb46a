"""The batch engine against a plain loop, and what it promises."""

import dataclasses
import functools

import mujoco
import numpy as np
import pytest
from mujoco.batch import SimulationError

from tcbi_contract.names import JOINTS
from tcbi_sim.engine import Simulator, simulate
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.mjcf import materialise
from tcbi_sim.model import base_model
from tcbi_sim.rig import Noise
from tcbi_sim.simulator import TIMESTEP_S, step_for
from tcbi_sim.tasks import TASKS

RNG = np.random.default_rng(3)
SCENARIOS = [TASKS["balance"].draw(RNG, seed) for seed in range(3)]
SHORT = [Scenario("balance", 1.0, s.slope_roll, s.slope_pitch, seed=s.seed) for s in SCENARIOS]
NOISE = Noise(joint_position=0.02, attitude=0.05)
COMMANDS = [Commands(np.arange(5) * 0.2, np.random.default_rng(i).uniform(-0.3, 0.3, (5, 18))) for i in range(3)]


class Dither:
    """A closed loop that depends on what it sees."""

    def reset(self, count, rng):
        self.count = count

    def act(self, time, observation):
        return 0.2 * np.sin(3 * time + np.arange(18)) - 0.3 * observation[:, :18]


def test_the_same_bits_at_any_number_of_threads_and_any_chunk():
    model = base_model("hexapod")
    values = model.sample(np.random.default_rng(0), 6)
    one = simulate(model, values, SHORT, controller=Dither(), timestep=0.01, threads=1)
    two = simulate(model, values, SHORT, controller=Dither(), timestep=0.01, threads=2, chunk=5)
    np.testing.assert_array_equal(one.joint_position, two.joint_position)
    np.testing.assert_array_equal(one.attitude, two.attitude)


def test_replaying_its_own_commands_repeats_a_closed_loop_bit_for_bit():
    model = base_model("hexapod")
    values = model.sample(np.random.default_rng(0), 1)
    closed = simulate(model, values, SHORT, controller=Dither(), timestep=0.01)
    recorded = [closed.measurement(0, s).commands for s in range(3)]
    replayed = simulate(model, values, SHORT, commands=recorded, timestep=0.01)
    np.testing.assert_array_equal(closed.joint_position, replayed.joint_position)


class Echo:
    """Commands what it sees of the joints and of the attitude."""

    def reset(self, count, rng):
        pass

    def act(self, time, seen):
        return np.concatenate([seen[:, 18:], seen[:, 3:18]], axis=1)


def test_what_a_controller_reads_has_the_sensors_noise_and_each_simulation_its_own():
    model = base_model("hexapod")
    values = model.from_unit(np.random.default_rng(3).random((3, 3)))
    run = functools.partial(simulate, model, controller=Echo(), timestep=0.01)
    clean, noisy = run(values, SHORT), run(values, SHORT, noise=NOISE)
    first = (noisy.commands_given - clean.commands_given)[:, :, 0]  # of the same posture; later ones went other ways
    assert first[..., 3:].std() == pytest.approx(0.02, rel=0.4) and first[..., :3].std() == pytest.approx(0.05, rel=0.5)
    assert len(np.unique(first[..., 0])) == first[..., 0].size
    alone = run(values[2:], SHORT[1:], noise=NOISE, chunk=1)
    np.testing.assert_array_equal(alone.commands_given[0, 0], noisy.commands_given[2, 1])


def test_scenarios_of_one_seed_are_misread_each_in_its_own_way_however_they_are_divided_up():
    model = base_model("hexapod")
    values = model.from_unit(np.random.default_rng(3).random((2, 3)))
    still = [Scenario("balance", 0.4)] * 3
    run = functools.partial(simulate, model, values, still, controller=Echo(), timestep=0.01, noise=NOISE)
    together, apart = run(), run(chunk=1)
    first = together.commands_given[:, :, 0, 3]
    assert len(np.unique(first)) == first.size
    np.testing.assert_array_equal(together.commands_given, apart.commands_given)


def lossy(seeds: list[int], chunk: int = 512) -> np.ndarray:
    """(N, S, T) what a servo does that loses half of the same commands, in scenarios of these seeds."""
    model = base_model("servo_bench").with_effect("lost_commands")
    values = np.tile([4e-3, 0.015, 0.02, 0.5], (2, 1)) * [[1.0], [0.9]]
    commands = Commands(np.arange(20) * 0.05, np.tile([[0.5], [-0.5]], (10, 1)), 0.0)
    scenarios = [Scenario("bench", 1.0, seed=seed) for seed in seeds]
    out = simulate(model, values, scenarios, commands=[commands] * len(seeds), timestep=0.01, chunk=chunk)
    return out.joint_position[..., 0]


def test_scenarios_of_one_seed_lose_other_commands_and_those_of_other_seeds_the_same_as_ever():
    logs = lossy([0] * 4)
    assert len(np.unique(logs[0], axis=0)) == 4, "imported logs all have seed 0"
    np.testing.assert_array_equal(logs, lossy([0] * 4, chunk=3))
    apart = lossy([5, 0, 7])
    for s, seed in enumerate([5, 0, 7]):
        np.testing.assert_array_equal(apart[:, s], lossy([seed])[:, 0])
    np.testing.assert_array_equal(apart[:, 1], logs[:, 0])


def test_a_reset_keeps_which_commands_a_simulation_loses_and_new_scenarios_bring_their_own():
    model = base_model("servo_bench").with_effect("lost_commands")
    same = [Scenario("bench", 1.0)] * 2
    simulator = Simulator(model, np.tile([4e-3, 0.015, 0.02, 0.5], (2, 1)), same, 0.01, threads=1, repeats=[0, 1])

    def motion() -> np.ndarray:
        parts = []
        for k in range(20):
            simulator.command(np.full((2, 1), 0.5 * (-1) ** k), ramp=0.0)
            parts.append(simulator.advance(0.05).joint_position[..., 0])
        return np.concatenate(parts, axis=1)

    first = motion()
    assert not np.array_equal(first[0], first[1])
    simulator.reset(rewind=True)
    np.testing.assert_array_equal(motion(), first)
    simulator.reset(scenarios=same, repeats=[1, 0], rewind=True)
    np.testing.assert_array_equal(motion(), first[::-1])
    simulator.reset(scenarios=same, rewind=True)
    np.testing.assert_array_equal(motion(), first[[0, 0]])


def test_a_rollout_does_not_depend_on_when_others_are_commanded():
    model = base_model("hexapod")
    values = np.array([[0.75, 0.8, 2.5]])
    later = Commands(COMMANDS[1].time + 0.07, COMMANDS[1].target)
    together = simulate(model, values, SHORT[:2], commands=[COMMANDS[0], later], timestep=0.01)
    for s, commands in enumerate([COMMANDS[0], later]):
        alone = simulate(model, values, SHORT[s : s + 1], commands=[commands], timestep=0.01)
        np.testing.assert_array_equal(together.joint_position[0, s], alone.joint_position[0, 0])


@pytest.mark.parametrize("effects", [(), ("command_latency",)])
def test_each_rollout_has_its_own_ramp_whatever_the_others_have(effects):
    model = base_model("servo_bench")
    for effect in effects:
        model = model.with_effect(effect)
    values = model.sample(np.random.default_rng(0), 2)
    times = np.arange(5) * 0.21
    streams = [Commands(times, np.random.default_rng(i).normal(size=(5, 1)), r) for i, r in enumerate((0.0, 0.4, 0.1))]
    run = functools.partial(simulate, model, values, timestep=0.005)
    together = run([Scenario("bench", 1.0)] * 3, commands=streams)
    chunked = run([Scenario("bench", 1.0)] * 3, commands=streams, chunk=2)
    np.testing.assert_array_equal(together.joint_position, chunked.joint_position)
    for s, stream in enumerate(streams):
        alone = run([Scenario("bench", 1.0)], commands=[stream])
        np.testing.assert_array_equal(together.joint_position[:, s], alone.joint_position[:, 0])


def test_a_command_that_comes_within_a_step_counts_for_the_rest_of_it():
    """A latency acts to the instant: in whole steps no fit could follow it."""
    model = base_model("servo_bench").with_effect("command_latency")
    asked = Commands(np.array([0.1, 0.3]), np.array([[0.8], [-0.4]]), ramp=0.0)

    def moved(delay: float) -> np.ndarray:
        values = np.array([[4e-3, 0.03, 1e-4, delay]])
        scenario = Scenario("bench", 0.6, constants=(("kp", 60.0), ("mass", 0.3), ("length", 0.1)))
        return simulate(model, values, [scenario], commands=[asked], timestep=0.005).joint_position[0, 0, :, 0]

    whole = moved(0.045) - moved(0.04)
    for share in (0.25, 0.5, 0.75):
        part = moved(0.04 + share * 0.005) - moved(0.04)
        assert part @ whole / (whole @ whole) == pytest.approx(share, abs=0.01)


def test_the_batch_agrees_with_a_plain_loop_over_mj_step():
    model = base_model("servo_bench")
    values = np.array([[4e-3, 0.03, 0.02]])
    step = Commands(np.array([0.1]), np.array([[1.0]]), ramp=0.0)
    scenario = Scenario("bench", 0.5, constants=(("kp", 400.0), ("mass", 0.3), ("length", 0.1)))
    out = simulate(model, values, [scenario], commands=[step], timestep=0.001)
    plain = materialise(model, values[0])
    plain.body_mass[1], plain.opt.timestep = 0.3, 0.001
    plain.actuator_gainprm[0, 0] = 4e-3 * 400
    plain.actuator_biasprm[0, 1] = -4e-3 * 400
    mujoco.mj_setConst(plain, mujoco.MjData(plain))
    data, expected = mujoco.MjData(plain), []
    for k in range(501):
        data.ctrl[0] = 1.0 if (k + 0.5) * 0.001 >= 0.1 else 0.0
        if k % 10 == 0:
            expected.append(data.qpos[0])
        mujoco.mj_step(plain, data)
    np.testing.assert_allclose(out.joint_position[0, 0, :, 0], expected, atol=1e-9)


def test_an_arm_swings_more_freely_without_power_than_with_a_servo_that_asks_for_nothing():
    model = base_model("servo_bench")
    scenario = Scenario("bench", 1.0, initial_joint_position=(1.0,), settle=0.0)
    values = np.array([[2e-4, 5e-3, 1e-3]])
    asked = np.zeros((1, 1))
    powered, limp = (
        simulate(
            model,
            values,
            [scenario],
            commands=[Commands(np.zeros(1), asked, ramp=0.0, torque_on=np.array([on]))],
            timestep=0.001,
        ).joint_position.min()
        for on in (True, False)
    )
    assert limp < -0.75, "swings through to the other side"
    assert powered > limp + 0.1, "back-EMF brakes it"


def test_power_acts_at_its_own_time_however_the_others_are_switched():
    model = base_model("servo_bench")
    values = model.mean()[None]
    scenario = Scenario("bench", 1.0, settle=0.0)
    times = np.arange(20) * 0.05

    def switched(at: float) -> Commands:
        return Commands(times, np.full((20, 1), 0.5), ramp=0.0, torque_on=times < at)

    streams = [switched(0.4), switched(0.65)]
    together = simulate(model, values, [scenario] * 2, commands=streams, timestep=0.005)
    for s, stream in enumerate(streams):
        alone = simulate(model, values, [scenario], commands=[stream], timestep=0.005)
        np.testing.assert_array_equal(together.joint_position[0, s], alone.joint_position[0, 0])
    early, late = together.joint_position[0, 0, :, 0], together.joint_position[0, 1, :, 0]
    np.testing.assert_array_equal(early[:41], late[:41])
    assert np.all(early[42:66] < late[42:66])


@pytest.mark.parametrize("timestep", [0.002, 0.005, 0.01])
def test_a_servo_in_steady_motion_is_as_far_behind_whatever_the_time_step(timestep):
    """Half a step less behind would pass for a servo that is some 5 % stiffer, of steps of 5 ms."""
    speed = 1.0  # rad/s
    commands = [Commands(np.zeros(1), np.full((1, 1), speed), ramp=1.0)]
    scenarios = [Scenario("log", 0.9, settle=0.0, constants=(("mass", 0.1),))]
    simulated = functools.partial(
        simulate, base_model("servo_bench"), np.array([[5e-3, 0.02, 0.002]]), scenarios, commands=commands
    )
    steady = slice(30, None)  # samples after the start has died away
    reference = simulated(timestep=0.0002).joint_position[0, 0, steady, 0]
    found = simulated(timestep=timestep).joint_position[0, 0, steady, 0]
    assert abs(np.mean(found - reference)) < 0.1 * timestep * speed


def test_a_servo_reaches_its_target_on_a_linear_ramp():
    model = base_model("servo_bench")
    simulator = Simulator(
        model,
        np.array([[5e-2, 1e-3, 1e-3]]),
        [Scenario("bench", 1.0, constants=(("kp", 400.0), ("mass", 0.02)))],
        0.001,
    )
    simulator.command(np.array([[0.5]]), ramp=0.2)
    samples = simulator.advance(0.3)
    assert samples.joint_position[0, 9, 0] == pytest.approx(0.25, abs=0.05), "half way at half the ramp's time"
    assert samples.joint_position[0, -1, 0] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("effects", [(), ("thermal_fading",), ("link_flexibility",)])
def test_without_forces_the_last_reading_moves_the_same(effects):
    """Angles seen behind links that bend depend on the forces, and so does a servo's heat."""
    model = base_model("hexapod")
    for name in effects:
        model = model.with_effect(name)
    values = 0.5 * (model.sample(np.random.default_rng(0), 2) + model.sample(np.random.default_rng(1), 2))
    readings = []
    for forces in (True, False):
        simulator = Simulator(model, values, [Scenario("walk", 1.0)] * 2, 0.005)
        simulator.command(np.full((2, 18), 0.2))
        readings.append(simulator.advance(0.2, forces=forces))
    for name in ("joint_position", "attitude", "angular_velocity", "position"):
        full, least = (getattr(r, name) for r in readings)
        assert np.array_equal(full, least), name
    acceleration = [r.linear_acceleration for r in readings]
    assert np.array_equal(acceleration[0][:, :-1], acceleration[1][:, :-1])
    assert np.array_equal(acceleration[0][:, -1], acceleration[1][:, -1]) == bool(effects)


def test_a_diverging_simulation_is_marked_and_leaves_the_others_alone():
    model = base_model("hexapod")
    values = np.repeat([[0.75, 0.8, 2.5]], 2, axis=0)
    pair = Simulator(model, values, SHORT[:1] * 2, 0.01, threads=1)
    alone = Simulator(model, values[:1], SHORT[:1], 0.01, threads=1)
    pair._batch.bind("qvel")[1, :] = 1e12
    target = np.zeros((2, 18))
    pair.command(target)
    alone.command(target[:1])
    np.testing.assert_array_equal(pair.advance(1.0).joint_position[0], alone.advance(1.0).joint_position[0])
    assert pair.diverged.tolist() == [False, True]


def test_an_error_of_mujoco_in_one_simulation_costs_the_others_no_sample(monkeypatch):
    model = base_model("hexapod")
    values = np.repeat([[0.75, 0.8, 2.5]], 2, axis=0)
    pair, alone = (Simulator(model, values[:n], SHORT[:1] * n, 0.01, threads=1) for n in (2, 1))
    rollout = pair._batch.rollout

    def failing(*args, **options):
        rollout(*args, **options)
        options["out"]["sensordata"][1] = np.nan  # never written
        raise SimulationError(np.array([1]), "as MuJoCo does")

    monkeypatch.setattr(pair, "_batch", Failing(pair._batch, failing))
    pair.command(np.zeros((2, 18)))
    alone.command(np.zeros((1, 18)))
    got, expected = pair.advance(1.0), alone.advance(1.0)
    np.testing.assert_array_equal(got.joint_position[0], expected.joint_position[0])
    assert got.joint_position.shape == (2, 50, 18) and np.isfinite(got.joint_position).all()
    assert pair.diverged.tolist() == [False, True]


class Failing:
    """A batch whose rollouts end in an error."""

    def __init__(self, batch, rollout) -> None:
        self._batch, self.rollout = batch, rollout

    def __getattr__(self, name):
        return getattr(self._batch, name)


def test_a_reset_of_one_simulation_leaves_the_others_running():
    model = base_model("hexapod")
    values = np.repeat([[0.75, 0.8, 2.5]], 2, axis=0)
    once, both = (Simulator(model, values, SHORT[:2], 0.01, threads=1) for _ in range(2))
    target = np.tile(COMMANDS[0].target[0], (2, 1))
    for simulator in (once, both):
        simulator.command(target)
        simulator.advance(0.2)
    both.reset(np.array([1]), parameters=np.array([[0.9, 1.0, 3.0]]))
    for simulator in (once, both):
        simulator.command(target)
    np.testing.assert_array_equal(once.advance(0.2).joint_position[0], both.advance(0.2).joint_position[0])


def test_limp_servos_let_the_robot_sink():
    simulator = Simulator(base_model("hexapod"), np.array([[0.75, 0.8, 2.5]]), [Scenario("balance", 2.0)], threads=1)
    height = simulator.observe().position[0, 0, 2]
    simulator.set_torque(False)
    assert simulator.advance(1.0).position[0, -1, 2] < height - 0.02


def test_wrong_shapes_and_modes_are_refused_in_words():
    model = base_model("hexapod")
    values = model.mean()[None]
    with pytest.raises(SimError, match="either commands"):
        simulate(model, values, SHORT)
    with pytest.raises(SimError, match="command sequences"):
        simulate(model, values, SHORT, commands=COMMANDS[:1])
    with pytest.raises(SimError, match="friction, mass, gain"):
        simulate(model, values[:, :2], SHORT, commands=COMMANDS)
    with pytest.raises(SimError, match=r"timestep 0\.003 s does not divide .* 0\.02 s, .* such as 0\.00285714286 s"):
        Simulator(model, values, SHORT[:1], 0.003)
    with pytest.raises(SimError, match="allowed is more than 0"):
        simulate(model, values, SHORT, commands=COMMANDS, timestep=0.0)


def test_a_models_joint_gains_act_as_the_same_gains_set_joint_by_joint():
    gains = np.linspace(0.9, 1.1, 18)
    plain = odd = base_model("hexapod")
    for joint in JOINTS:
        odd = odd.with_effect(f"gain_scatter:{joint}")
    known = dataclasses.replace(plain, joint_gains=tuple(gains))
    scenario, still = [Scenario("balance", 0.5, slope_roll=0.1)], [Commands(np.zeros(1), np.zeros((1, 18)))]
    values = plain.mean()
    expected, alike, found = (
        simulate(model, vector[None], scenario, commands=still).joint_position
        for model, vector in ((odd, np.r_[values, gains]), (plain, values), (known, values))
    )
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found - alike).max() > 1e-3


@pytest.mark.parametrize(
    ("rate", "at_most", "steps"),
    [(50, 0.002, 10), (50, 0.005, 4), (100, 0.002, 5), (100, 0.005, 2), (50, 0.01, 2),
     (30, 0.002, 17), (60, 0.005, 4), (125, 0.005, 2), (200, 0.002, 3), (240, 0.002, 3), (1000, 0.005, 1)],
)  # fmt: skip
def test_the_longest_time_step_up_to_a_limit_divides_the_sample_interval(rate, at_most, steps):
    assert step_for(rate, at_most) == 1 / (rate * steps) <= at_most


@pytest.mark.parametrize("rate", [30, 60, 125, 200, 240, 250, 500, 1000])
def test_a_rig_is_simulated_at_any_rate(rate):
    model, turn = base_model("servo_bench"), Commands(np.zeros(1), np.ones((1, 1)), 0.0)
    run = functools.partial(simulate, model, model.mean()[None], [Scenario("bench", 0.5)], commands=[turn], rate=rate)
    fine, coarse = (run(timestep=step).joint_position[0, 0, :, 0] for step in (TIMESTEP_S, 0.005))
    assert len(fine) == rate // 2 + 1
    np.testing.assert_allclose(fine, coarse, atol=0.02)
