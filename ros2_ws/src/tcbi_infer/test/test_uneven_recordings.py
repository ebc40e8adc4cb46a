"""Recordings that did not all measure the same, nor at the same rate: nothing is lost, and the floor is right."""

import dataclasses

import numpy as np
import pytest
from legged_cases import motions, noisy, walk

from tcbi_infer.compare import comparison as module
from tcbi_infer.compare import task
from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.noise import from_fast_changes, noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Replicates
from tcbi_infer.compare.scorer import SignalError
from tcbi_infer.compare.signals import ACCELERATION, ATTITUDE, CONTACT, JOINT, RATE, Layout, window_mean
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement, Scenario
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")
WITHOUT_IMU = {"attitude": None, "angular_velocity": None, "linear_acceleration": None}


@pytest.fixture(scope="module")
def rollouts():
    return walk()


def until(m: Measurement, end: float) -> Measurement:
    """The same recording, cut short."""
    keep = m.time <= end
    names = ("time", "joint_position", "attitude", "angular_velocity", "linear_acceleration", "contact", "position")
    return dataclasses.replace(m, **{name: getattr(m, name)[keep] for name in names})


@pytest.mark.parametrize(("task", "lacking"), [("balance", WITHOUT_IMU), ("forward", {"position": None})])
def test_the_rollout_with_most_commands_may_lack_what_the_reward_needs(task, lacking):
    rng = np.random.default_rng(0)
    commands = [*motions(1), *motions(1, 4.0)]
    scenarios = [Scenario(task, 2.4), Scenario(task, 4.0)]
    out = simulate(MODEL, MODEL.mean()[None], scenarios, commands=commands)
    each = [noisy(out.measurement(0, s), commands[s], s, 0, rng) for s in range(2)]
    mixed = compare(MODEL, [each[0], dataclasses.replace(each[1], **lacking)], particles=2, timestep=0.002)
    alone = compare(MODEL, each[:1], particles=2, timestep=0.002)
    reward, expected = (next(e for e in c.signals if e.name == "reward") for c in (mixed, alone))
    assert reward.error == pytest.approx(expected.error) and reward.crps == pytest.approx(expected.crps)


def test_a_repeat_that_measured_less_costs_its_partner_nothing(rollouts):
    uneven = [until(rollouts[0], 1.2), dataclasses.replace(rollouts[1], **WITHOUT_IMU), *rollouts[2:]]
    replay = Replay.of(MODEL, uneven)
    mean, whole = replay.means(), Replay.of(MODEL, rollouts)
    joint, roll = replay.layout.index("lf_tibia"), replay.layout.index("roll")
    late, early = replay.time > 1.3, replay.time < 1.1
    assert np.array_equal(mean[0, late, joint], whole.measured[1, late, joint])
    assert np.array_equal(mean[0, early, roll], whole.measured[0, early, roll])
    assert np.array_equal(mean[:, early, joint], whole.means()[:, early, joint])
    assert np.isnan(mean[0, late, roll]).all()
    weight = Problem.of(replay, np.ones(len(replay.layout.channels))).weight
    assert weight[0, late, joint].all() and weight[0, early, roll].all() and not weight[0, late, roll].any()


def test_three_repeats_of_which_one_lacks_a_signal_still_show_its_floor():
    layout = Layout.of(walk(repeats=1, count=1))
    measured = np.random.default_rng(0).normal(0, 0.2, (3, 400, len(layout.channels)))
    roll = layout.index("roll")
    measured[2, :, roll] = np.nan
    floor = noise_floor(layout, measured, measured, [Replicates((0, 1, 2), 0)])
    assert floor.replicated(roll) and floor.values[roll] == pytest.approx(0.2, rel=0.15)


def test_repeats_that_did_not_measure_the_same_are_told(rollouts):
    assert guard(rollouts) == []
    short, blind = until(rollouts[0], 1.2), dataclasses.replace(rollouts[3], **WITHOUT_IMU)
    findings = guard([short, rollouts[1], rollouts[2], blind])
    assert (
        "Ends at 1.2 s, a repeat of the same commands at 2.4 s: the repeat counts alone there (motion0_0)." in findings
    )
    assert (
        "A repeat of the same commands has attitude, angular_velocity, linear_acceleration, which is missing here: the "
        "repeat counts alone there (motion1_1)."
    ) in findings


def test_commands_of_repeats_that_came_at_other_times_are_told(rollouts):
    def later(m: Measurement, by: float) -> Measurement:
        time = m.commands.time + by * (np.arange(len(m.commands.time)) == 3)
        return dataclasses.replace(m, commands=dataclasses.replace(m.commands, time=time))

    assert guard([later(rollouts[0], 0.008), *rollouts[1:]]) == []
    assert guard([later(rollouts[0], 0.023), *rollouts[1:]]) == [
        "Its commands and those of its repeats came up to 23 ms apart, and the noise floor counts what that changes as "
        "the robot's own: record them again when the machine has nothing else to do (motion0_0)."
    ]


def white(rng: np.random.Generator, shape: tuple[int, ...], layout: Layout) -> np.ndarray:
    """Noise of 2 in every sample, averaged as the layout has it."""
    noise = rng.normal(0, 2.0, (*shape, len(layout.channels)))
    for group in (RATE, ACCELERATION, CONTACT):
        noise[..., layout.where(group)] = window_mean(noise[..., layout.where(group)], layout.samples_in(group))
    return noise


def test_the_estimated_floor_of_averages_is_their_own_noise():
    layout = Layout.of(walk(repeats=1, count=1))
    residual = white(np.random.default_rng(0), (4, 1500), layout)
    floor = noise_floor(layout, residual, residual, [Replicates((r,), r) for r in range(4)]).values
    for group, expected in ((JOINT, 2.0), (ATTITUDE, 2.0), (RATE, 2.0 / np.sqrt(3)), (CONTACT, 2.0 / np.sqrt(5))):
        assert np.mean(floor[layout.where(group)]) == pytest.approx(expected, rel=0.05)


def test_the_estimated_floor_of_single_samples_is_the_root_of_their_second_differences():
    residual = np.random.default_rng(0).normal(size=(3, 200, 4))
    residual[1, 50:60, 2] = np.nan
    second = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
    assert from_fast_changes(residual) == pytest.approx(np.sqrt(np.nanmean(second**2, axis=(0, 1)) / 6), rel=1e-12)


@pytest.mark.parametrize("rate", [10.0, 20.0, 33.0])
@pytest.mark.parametrize("late", [0.0, 0.007])
def test_the_estimated_floor_of_a_slow_recording_is_its_sensors_noise(rollouts, rate, late):
    """On the common grid most values of such a recording are interpolated, and smoother than its readings."""
    m, rng = rollouts[0], np.random.default_rng(0)
    own = np.arange(1 / rate, 2.39, 1 / rate) + late
    slow = m.resampled(own)
    slow = dataclasses.replace(slow, joint_position=rng.normal(0, 0.02, slow.joint_position.shape))
    replay = Replay.of(MODEL, [slow])
    floor = replay.noise_floor(replay.measured).values[replay.layout.where(JOINT)]
    assert np.sqrt(np.mean(floor**2)) == pytest.approx(np.degrees(0.02), rel=0.25)


def test_a_recording_at_the_rate_of_the_grid_has_readings_everywhere(rollouts):
    jitter = np.random.default_rng(0).uniform(-0.009, 0.009, len(rollouts[0].time))
    live = dataclasses.replace(rollouts[0], time=rollouts[0].time + jitter)
    assert Replay.of(MODEL, [live]).readings.all()


def of_lengths(*durations: float) -> list[Measurement]:
    """A motion of each length, as the model's mean performs it."""
    commands = [motions(1, d)[0] for d in durations]
    scenarios = [Scenario("balance", d, slope_roll=0.02 * i) for i, d in enumerate(durations)]
    out = simulate(MODEL, MODEL.mean()[None], scenarios, commands=commands)
    each = [out.measurement(0, s, f"motion{s}") for s in range(len(durations))]
    return [dataclasses.replace(m, commands=c) for m, c in zip(each, commands, strict=True)]


def test_a_short_motion_beside_a_long_one_is_simulated_to_its_own_end_with_the_same_result(monkeypatch):
    each = of_lengths(1.0, 6.0, 2.0, 1.2)
    replay, values = Replay.of(MODEL, each), np.stack([MODEL.mean(), MODEL.mean() * 1.1])
    asked = []

    def counted(model, parameters, scenarios, **options):
        asked.append([s.duration for s in scenarios])
        return simulate(model, parameters, scenarios, **options)

    monkeypatch.setattr("tcbi_infer.compare.replay.simulate", counted)
    rollouts = replay.simulate(MODEL, values)
    assert sorted(len(durations) for durations in asked) == [1, 1, 2]
    assert sum(d for durations in asked for d in durations) < 11.0
    whole = simulate(MODEL, values, replay.scenarios, commands=replay.commands, rate=replay.layout.rate)
    assert np.array_equal(rollouts.time, whole.time) and rollouts.scenarios == whole.scenarios
    there = np.isfinite(replay.measured)
    some, every = (replay.channels(r) for r in (rollouts, whole))
    assert np.array_equal(some[:, there], every[:, there])
    (alone,) = replay.predict(MODEL, values[:1], [3])
    assert np.array_equal(alone[0], some[0, 3])


def test_motions_of_nearly_one_length_are_simulated_together_to_the_last_bit():
    replay = Replay.of(MODEL, of_lengths(2.0, 2.4))
    rollouts = replay.simulate(MODEL, MODEL.mean()[None])
    whole = simulate(MODEL, MODEL.mean()[None], replay.scenarios, commands=replay.commands, rate=replay.layout.rate)
    assert np.array_equal(rollouts.joint_position, whole.joint_position)


def dead(m: Measurement, *signals: str, begin: float = 1.2, end: float = 2.4) -> Measurement:
    """The same recording; some sensors told nothing in a while, and their last value stands there."""
    held = {}
    for name in signals:
        values = getattr(m, name).copy()
        lost = (m.time > begin) & (m.time <= end)
        values[lost] = values[max(int(np.argmax(lost)) - 1, 0)]
        held[name] = values
    return dataclasses.replace(m, **held, gaps=tuple((name, begin, end) for name in signals))


def errors(rollouts: list[Measurement]) -> dict[str, SignalError]:
    found = compare(MODEL, rollouts, particles=0)
    return {e.name: e for e in (*found.signals, *found.statistics)}


def test_what_a_sensor_did_not_tell_is_in_no_figure_of_the_task(rollouts):
    lame = dead(rollouts[0], "position", "contact")
    replay, whole = Replay.of(MODEL, [lame]), Replay.of(MODEL, rollouts[:1])
    told, expected = task.measured(replay), task.measured(whole)
    late, early = replay.time > 1.26, replay.time < 1.14
    assert np.isnan(told["distance"][0, late]).all() and np.isnan(told["distance_end"]).all()
    assert np.array_equal(told["distance"][0, early], expected["distance"][0, early])
    assert np.array_equal(told["return"], expected["return"]), "no position counts in it"
    share = whole.measurements[0].contact[replay.time <= 1.15, 0].mean()
    assert told["contact_ratio_lf"][0, 0] == pytest.approx(share, abs=0.01)
    found, right = errors([lame, *rollouts[1:]]), errors(rollouts)
    assert found["distance"].error < 1.3 * right["distance"].error
    assert found["contact_ratio_lf"].error < right["contact_ratio_lf"].error + 0.01


def test_an_attitude_that_stopped_early_makes_no_return_and_no_final_inclination(rollouts):
    told = task.measured(Replay.of(MODEL, [dead(rollouts[0], "attitude"), *rollouts[2:]]))
    for name in ("return", "final_inclination"):
        assert np.isfinite(told[name][:, 0]).tolist() == [False, True, True]


def test_without_the_start_of_the_path_there_is_no_distance(rollouts, monkeypatch):
    monkeypatch.setattr(module, "MEMORY", 1)  # one motion at a time
    late = dataclasses.replace(dead(rollouts[0], "position", begin=0.0, end=0.5), distance=0.3)
    found = compare(MODEL, [late, rollouts[2]], particles=2)
    alone = compare(MODEL, [rollouts[2]], particles=2)
    distance, expected = (next(e for e in c.signals if e.name == "distance") for c in (found, alone))
    assert distance.error == pytest.approx(expected.error)
