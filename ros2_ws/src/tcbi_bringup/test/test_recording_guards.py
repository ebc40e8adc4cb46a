"""Faults planted in what the emulated robot recorded are named; a clean recording raises no finding."""

import dataclasses

import numpy as np
import pytest

from tcbi_bringup.emulated_robot.as_measurement import measure
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_infer.collection import Request, scenario_of
from tcbi_infer.compare.clocks import Following, aligned
from tcbi_infer.compare.common_lag import common_lag
from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.guards import guard, to_mend
from tcbi_infer.compare.signals import Layout, reference
from tcbi_policy.gaits import Gait
from tcbi_sim.measurement import Commands, Measurement
from tcbi_sim.model import base_model

LATENCY = "command_latency"


def recorded(hidden: str) -> list[Measurement]:
    """Two motions of a robot, each twice."""
    robot = EmulatedRobot(511, hidden, "strong")
    rollouts = []
    for i, gait in enumerate(("sinus", "dither")):
        request = Request("balance", 1, i, slope_roll=(0.1,), slope_pitch=(0.0,), duration_s=4.0)
        for trial in (0, 1):
            m = measure(robot, scenario_of(request, 0), Gait(gait), trial=2 * i + trial)
            rollouts.append(dataclasses.replace(m, rollout_id=f"{gait}-{trial}"))
    return rollouts


@pytest.fixture(scope="module")
def clean() -> list[Measurement]:
    return recorded("none")


def late(m: Measurement, by: float) -> Measurement:
    """The same rollout stamped `by` seconds later than it was measured."""
    return dataclasses.replace(m, time=m.time + by)


def without(m: Measurement, begin: float, end: float) -> Measurement:
    """The same rollout without any message between two times (s)."""
    names = ("time", "joint_position", "attitude", "angular_velocity", "linear_acceleration", "contact", "position")
    kept = (m.time <= begin) | (m.time >= end)
    rows = {name: getattr(m, name)[kept] for name in names if getattr(m, name) is not None}
    told = (m.commands.time <= begin) | (m.commands.time >= end)
    commands = dataclasses.replace(m.commands, time=m.commands.time[told], target=m.commands.target[told])
    return dataclasses.replace(m, commands=commands, **rows)


def with_joints(m: Measurement, joints: np.ndarray) -> Measurement:
    return dataclasses.replace(m, joint_position=joints)


def swapped(m: Measurement, a: int, b: int) -> Measurement:
    order = np.arange(18)
    order[[a, b]] = b, a
    return with_joints(m, m.joint_position[:, order])


def held(m: Measurement, every: int) -> Measurement:
    """Readings that come only every so many samples, at the old rate."""
    rows = np.arange(len(m.time)) // every * every
    return with_joints(m, m.joint_position[rows])


def echo(m: Measurement, joints: slice = slice(None)) -> Measurement:
    copy = m.joint_position.copy()
    rows = np.clip(np.searchsorted(m.commands.time, m.time + 1e-6) - 1, 0, None)
    copy[:, joints] = m.commands.target[rows][:, joints]
    return with_joints(m, copy)


def ramped_echo(m: Measurement) -> Measurement:
    """The commands' ramps as a 12-bit encoder would read them, a few milliseconds late."""
    step = 2 * np.pi / 4096
    return with_joints(m, np.round(reference(m, m.time - 0.0073) / step) * step)


BY_TYPE = np.arange(18).reshape(6, 3).T.ravel()  # all coxas first, then femurs, then tibias


def scaled(m: Measurement, by: float) -> Measurement:
    """Positions and commands alike in another unit."""
    commands = dataclasses.replace(m.commands, target=by * m.commands.target)
    return dataclasses.replace(m, joint_position=by * m.joint_position, commands=commands)


def clocked(m: Measurement, by: float) -> Measurement:
    """All times in another unit."""
    commands = dataclasses.replace(m.commands, time=by * m.commands.time)
    return dataclasses.replace(m, time=by * m.time, commands=commands)


def gyro(m: Measurement, change) -> Measurement:
    return dataclasses.replace(m, angular_velocity=change(m.angular_velocity))


SIGN = np.where(np.arange(18) == 4, -1.0, 1.0)
FAULTS = {
    "the commands' clock is late": (lambda m: late(m, -0.15), "lead their commands"),
    "the sensors' clock is far behind": (lambda m: late(m, 0.6), "half a second"),
    "another epoch": (lambda m: late(m, 3.0), "more than 1 s away from the rollout's begin"),
    "the sensors' clock runs fast": (
        lambda m: dataclasses.replace(m, time=m.time * 1.06), "% fast against that of the commands"),
    "slow readings in a fast stream": (lambda m: held(m, 3), "change only 17 times a second"),
    "bursts": (
        lambda m: dataclasses.replace(m, time=m.time - 0.018 * (np.arange(len(m.time)) % 3)), "but delivers"),
    "mirrored joint": (lambda m: with_joints(m, m.joint_position * SIGN), "lm_femur moves against its command"),
    "swapped joints": (lambda m: swapped(m, 0, 8), "lf_coxa and lr_tibia follow each other's commands"),
    "joints in another order": (
        lambda m: with_joints(m, m.joint_position[:, BY_TYPE]), "their columns may stand in another order"),
    "all signs": (lambda m: with_joints(m, -m.joint_position), "18 joints move against their commands"),
    "echo of ramps": (ramped_echo, "identical to the commands"),
    "encoder counts": (lambda m: with_joints(m, 2048 + m.joint_position * 651.9), "raw encoder counts"),
    "centred encoder counts": (lambda m: with_joints(m, m.joint_position * 651.9), "raw encoder counts"),
    "commands and positions in degrees": (lambda m: scaled(m, np.degrees(1.0)), "another unit than radians"),
    "milliseconds taken for seconds": (lambda m: clocked(m, 1e3), "The samples come 20 s apart"),
    "seconds taken for milliseconds": (lambda m: clocked(m, 1e-3), "The samples come 20 us apart"),
    "degrees": (lambda m: with_joints(m, np.degrees(m.joint_position)), "look like degrees"),
    "echo": (echo, "identical to the commands"),
    "echo of one leg": (lambda m: echo(m, slice(3, 6)), "lm_coxa, lm_femur, lm_tibia are identical to their commands"),
    "gyro in degrees": (lambda m: gyro(m, np.degrees), "degrees a second"),
    "gyro upside down": (lambda m: gyro(m, lambda w: w * [1, -1, -1]), "gyro's y axis turns against the attitude"),
    "gyro turned by a quarter": (
        lambda m: gyro(m, lambda w: w[:, [1, 0, 2]]),
        "gyro's x and y axes turn as the attitude does about each other's",
    ),
    "gravity taken out": (
        lambda m: dataclasses.replace(m, linear_acceleration=m.linear_acceleration * 0.01),
        "feels no gravity",
    ),
    "attitude that stands": (
        lambda m: dataclasses.replace(m, attitude=np.repeat(m.attitude[:1], len(m.time), axis=0)),
        "attitude never changes while the gyro turns"),
    "gyro that is dead": (lambda m: gyro(m, np.zeros_like), "gyro reads the same all the time"),
    "accelerometer upside down": (
        lambda m: dataclasses.replace(m, linear_acceleration=-m.linear_acceleration), "gravity the other way up"),
    "accelerometer's axes in another order": (
        lambda m: dataclasses.replace(m, linear_acceleration=m.linear_acceleration[:, [2, 0, 1]]),
        "deg off where the attitude has it"),
    "no contacts": (
        lambda m: dataclasses.replace(m, contact=np.zeros_like(m.contact)), "No foot ever touches the ground"),
    "contacts of one foot": (
        lambda m: dataclasses.replace(m, contact=m.contact & (np.arange(6) == 2)), "Less than two feet touch"),
    "tracker in millimetres": (
        lambda m: dataclasses.replace(m, position=1e3 * m.position), "look like millimetres"),
    "slope in degrees": (
        lambda m: dataclasses.replace(m, scenario=dataclasses.replace(m.scenario, slope_roll=5.7)),
        "slope by 5.7 rad"),
    "commands of another clock": (
        lambda m: dataclasses.replace(m, commands=dataclasses.replace(m.commands, time=m.commands.time + 100.0)),
        "All commands come after the last sample",
    ),
    "stamps that go back": (
        lambda m: dataclasses.replace(m, time=np.where(np.arange(len(m.time)) == 50, m.time - 0.1, m.time)),
        "repeat or go backwards",
    ),
    "accelerometer in g": (
        lambda m: dataclasses.replace(m, linear_acceleration=m.linear_acceleration / 9.81), "multiples of gravity"),
}  # fmt: skip


def test_clean_recordings_raise_no_finding(clean):
    assert guard(clean) == []


def test_a_robot_with_a_latency_is_no_fault_of_the_recording():
    slow = recorded(LATENCY)
    assert guard(slow) == [] and max(Following(m).lag for m in slow) > 0.06
    assert all(a is b for a, b in zip(aligned(slow).measurements, slow, strict=True))


@pytest.mark.parametrize("begin", [0.3, 0.8, 1.31])
def test_a_gap_in_a_short_recording_is_told_as_a_gap_alone(begin):
    request = Request("balance", 1, 0, slope_roll=(0.1,), slope_pitch=(0.0,), duration_s=2.2)
    m = measure(EmulatedRobot(512, "none", "strong"), scenario_of(request, 0), Gait("sinus"), trial=0)
    findings = guard([without(m, begin, begin + 0.5)])
    assert guard([m]) == [] and len(findings) == 2
    assert findings[0].startswith("No samples from") and findings[1].startswith("No commands from")


def test_a_clock_that_runs_fast_is_named_beside_a_gap(clean):
    plant, words = FAULTS["the sensors' clock runs fast"]
    findings = guard([plant(without(m, 1.0, 1.5)) for m in clean])
    assert any(words in finding for finding in findings), findings


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(clean, fault):
    plant, words = FAULTS[fault]
    findings = guard([plant(m) for m in clean])
    assert any(words in finding for finding in findings), findings


@pytest.mark.parametrize(
    "fault",
    [
        "mirrored joint",
        "swapped joints",
        "joints in another order",
        "all signs",
        "degrees",
        "centred encoder counts",
        "echo",
        "echo of ramps",
    ],
)
def test_physics_is_not_fitted_to_wrong_wiring_or_units(clean, fault):
    plant, words = FAULTS[fault]
    assert words in to_mend([plant(m) for m in clean])[0]
    assert to_mend([plant(clean[0]), *clean[1:]]) == [], "one rollout of four is no reason to look at none"


def test_nothing_is_to_be_mended_in_a_sound_recording_whatever_the_robot_lacks(clean):
    for rollouts in (clean, recorded(LATENCY), recorded("torque_saturation"), recorded("backlash")):
        assert to_mend(rollouts) == []


def test_a_repeat_that_is_late_as_a_whole_is_set_right(clean):
    broken = [clean[0], late(clean[1], 0.08), *clean[2:]]
    (finding,) = guard(broken)
    assert finding.startswith("All signals come 80 ms later than when the same commands were repeated")
    assert finding.endswith("(sinus-1).")
    put_right = aligned(broken).measurements
    assert np.abs(put_right[1].time - clean[1].time).max() < 0.011
    assert all(a is b for a, b in zip(put_right[2:], clean[2:], strict=True))


def test_a_clock_that_is_early_is_set_by_the_rollouts_beside_it(clean):
    put_right = aligned([*clean[:3], late(clean[3], -0.2)]).measurements[3]
    assert np.abs(put_right.time - clean[3].time).max() < 0.03


@pytest.mark.parametrize("joints", [[7], [1, 4, 7, 10, 13, 16]])
def test_a_latency_of_some_joints_is_an_effect_and_stays(clean, joints):
    m = clean[1]
    delayed = m.joint_position.copy()
    delayed[4:, joints] = m.joint_position[:-4, joints]
    rollouts = [clean[0], with_joints(m, delayed), *clean[2:]]
    assert guard(rollouts) == []
    assert aligned(rollouts).measurements[1] is rollouts[1]


def late_against(predicted: list[Measurement], measured: list[Measurement]) -> list[str]:
    """The finding about rollouts that another recording of the same motions predicts."""
    layout, time = Layout.of(predicted), np.arange(1, 200) / 50.0
    seen, said = (np.stack([layout.extract(m.resampled(time)) for m in each]) for each in (measured, predicted))
    return common_lag(layout, time, seen, said, [m.rollout_id for m in measured])


def test_the_robot_predicted_by_its_own_repeat_has_no_common_lag(clean):
    assert late_against(clean[::2], clean[1::2]) == []


def test_the_base_model_finds_no_common_lag_in_a_clean_recording(clean):
    guards = compare(base_model("hexapod"), clean, particles=0).guards
    assert not any("later than predicted" in g for g in guards)


def test_stamps_that_are_late_and_a_robot_that_is_late_look_the_same(clean):
    (stamps,) = late_against(clean[::2], [late(m, 0.08) for m in clean[1::2]])
    assert "come 80 ms later than predicted" in stamps
    (robot,) = late_against(clean[::2], recorded(LATENCY)[1::2])
    assert robot.startswith("All signals") and "these recordings cannot tell which" in robot


@pytest.mark.parametrize("joints", [[7], [1, 4, 7, 10, 13, 16], list(range(18))])
def test_joints_that_lag_alone_are_no_common_lag(clean, joints):
    slow = []
    for m in clean[1::2]:
        delayed = m.joint_position.copy()
        delayed[4:, joints] = m.joint_position[:-4, joints]
        slow.append(with_joints(m, delayed))
    assert late_against(clean[::2], slow) == []


def test_one_clock_that_leads_is_taken_out_of_all_rollouts_and_a_sound_one_is_left_alone(clean) -> None:
    lag = [Following(m).lag for m in clean]
    leading = aligned([late(m, -0.3) for m in clean]).measurements
    shifts = [a.time[0] - m.time[0] + 0.3 for a, m in zip(leading, clean, strict=True)]
    assert shifts == pytest.approx([0.3 - float(np.median(lag))] * 4, abs=0.02)
    mixed = aligned([late(clean[0], -0.3), *clean[1:]]).measurements
    assert all(a.time[0] == m.time[0] for a, m in zip(mixed[1:], clean[1:], strict=True))


def test_recordings_without_commands_keep_no_good_ones_from_a_diagnosis(clean):
    mute = [dataclasses.replace(m, commands=Commands(np.empty(0), np.empty((0, 18)))) for m in clean]
    assert to_mend([*mute, *mute, *clean]) == []
