"""Gaps: what is missing is found, and the model is not blamed for what it was not told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tcbi_contract.names import JOINT_COMMANDS
from tcbi_infer.bags.commands import read_commands
from tcbi_infer.bags.streams import Record
from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.errors import NothingToCompareError
from tcbi_infer.compare.replay import Replay
from tcbi_infer.gaps import Gap, command_gaps, sample_gaps, untold, unusable
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

GRID = np.arange(1, 201) / 50.0
COMMAND_TIMES = np.round(np.arange(20) * 0.2, 9)


def commands(times: np.ndarray = COMMAND_TIMES) -> Commands:
    phase = np.linspace(0, 5, 18)
    return Commands(times, 0.3 * np.sin(2 * np.pi * 0.7 * times[:, None] + phase))


def without(given: Commands, first: float, last: float) -> Commands:
    keep = (given.time < first - 1e-6) | (given.time > last + 1e-6)
    return dataclasses.replace(given, time=given.time[keep], target=given.target[keep])


@pytest.fixture(scope="module")
def rollout() -> Measurement:
    """A hexapod that is its own model's mean."""
    model = base_model("hexapod")
    scenario = Scenario("balance", 4.0)
    return simulate(model, model.mean()[None], [scenario], commands=[commands()]).measurement(0, 0)


def test_a_steady_stream_of_commands_has_no_gap_and_two_missing_commands_are_one():
    assert command_gaps(commands(), 4.0) == []
    assert command_gaps(without(commands(), 1.0, 1.2), 4.0) == [Gap(0.8, pytest.approx(1.4))]


def test_one_missing_command_is_said_and_costs_nothing(rollout):
    gone = dataclasses.replace(rollout, commands=without(rollout.commands, 1.0, 1.0))
    spoilt = unusable(gone, GRID)
    assert not spoilt.averages.any()
    assert spoilt.sentences == ("After the command at 0.80 s one is missing: it counts as never sent",)


def test_commands_that_stop_before_the_end_are_a_gap_without_end():
    assert command_gaps(without(commands(), 3.0, 4.0), 4.0) == [Gap(pytest.approx(2.8), np.inf)]


def test_commands_that_come_only_when_they_change_lack_none():
    assert command_gaps(commands(np.array([0.0, 0.2, 1.5, 2.9, 3.0])), 4.0) == []


@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_a_few_lost_samples_are_no_gap_and_half_a_second_is(jitter):
    time = GRID + jitter * np.random.default_rng(0).random(200)
    assert sample_gaps(np.delete(time, [50, 51, 120])) == []
    (gap,) = sample_gaps(np.delete(time, np.arange(50, 75)))
    assert gap.length == pytest.approx(0.52, abs=0.03)


def test_after_a_gap_in_its_commands_a_robot_on_feet_is_elsewhere_and_a_bench_was_told_nothing_new(rollout):
    gone = dataclasses.replace(rollout, commands=without(rollout.commands, 1.0, 1.8))
    spoilt = unusable(gone, GRID)
    assert not spoilt.averages[GRID < 0.99].any() and spoilt.samples[GRID > 1.01].all()
    assert "No commands from 0.80 to 2.00 s" in spoilt.sentences[0]
    on_a_bench = dataclasses.replace(gone, foot_names=(), contact=None)
    assert not unusable(on_a_bench, GRID).averages.any() and not unusable(on_a_bench, GRID).sentences


def test_what_the_joints_were_asked_is_unknown_from_the_first_missing_command_until_a_new_one_is_carried_out(rollout):
    gone = dataclasses.replace(rollout, commands=without(rollout.commands, 1.0, 1.8))
    asked_again = pytest.approx(2.0 + rollout.commands.ramp)
    assert untold(rollout) == [] and untold(gone) == [Gap(pytest.approx(1.0), asked_again)]
    kept = (rollout.time <= 0.9) | (rollout.time >= 1.9)
    samples = {"time": rollout.time[kept], "joint_position": rollout.joint_position[kept], "foot_names": ()}
    assert untold(dataclasses.replace(rollout, **samples)) == [], "the commands are there"
    assert untold(dataclasses.replace(gone, **samples)) == [Gap(pytest.approx(0.9, abs=0.021), asked_again)]


@pytest.mark.parametrize("lost", ["commands", "samples"])
def test_a_right_model_is_not_blamed_for_a_gap_in_the_recording(rollout, lost):
    if lost == "commands":
        gone = dataclasses.replace(rollout, commands=without(rollout.commands, 1.0, 1.8))
    else:
        keep = (rollout.time <= 1.0) | (rollout.time >= 2.0)
        signals = ("time", "joint_position", "attitude", "angular_velocity", "linear_acceleration", "contact")
        changed = {name: getattr(rollout, name)[keep] for name in signals}
        gone = dataclasses.replace(rollout, position=None, **changed)
    whole = compare(base_model("hexapod"), [rollout], particles=0)
    cut = compare(base_model("hexapod"), [gone], particles=0)
    assert cut.error_over_floor < 1.5 * whole.error_over_floor + 0.5
    assert any(f"No {lost} from" in guard for guard in cut.guards)


def test_a_gap_in_one_signal_costs_that_signal_alone(rollout):
    gone = dataclasses.replace(rollout, gaps=(("attitude", 1.0, 2.0),))
    spoilt = unusable(gone, GRID)
    assert list(spoilt.signals) == ["attitude"] and not spoilt.averages.any()
    inside = (GRID > 1.0) & (GRID < 2.0)
    replay = Replay.of(base_model("hexapod"), [gone])
    roll, joint = replay.layout.index("roll"), replay.layout.index("lf_coxa")
    assert np.isnan(replay.measured[0, inside, roll]).all()
    assert np.isfinite(replay.measured[0, ~inside & (GRID < 0.9), roll]).all()
    assert np.isfinite(replay.measured[0, :, joint]).all()


def test_a_bag_without_commands_is_named_as_such(rollout):
    mute = dataclasses.replace(rollout, rollout_id="mute", commands=Commands(np.empty(0), np.empty((0, 18))))
    with pytest.raises(NothingToCompareError, match=r"mute has no joint_commands; give at least one bag"):
        Replay.of(base_model("hexapod"), [mute])


@pytest.mark.parametrize(("late_s", "limp"), [(0.13, False), (0.19, False), (0.26, True)])
def test_a_late_command_acts_when_it_came_and_spoils_the_rest_only_if_the_robot_went_limp(rollout, late_s, limp):
    time = rollout.commands.time.copy()
    time[10:] = np.maximum(time[10:], time[10] + late_s)  # what was due meanwhile came with it
    time, last = np.unique(time[::-1], return_index=True)
    target = rollout.commands.target[::-1][last]
    late = unusable(dataclasses.replace(rollout, commands=Commands(time, target)), GRID)
    assert late.averages.any() == limp and bool(late.sentences) == limp


def recorded(delays_ms, offset_ms=0):
    """One joint's commands 1, 2, 3, ... at every 0.2 s, as they came to the recorder."""
    stamps = np.arange(len(delays_ms)) * 200_000_000
    came = stamps + (np.array(delays_ms) + offset_ms) * 1_000_000
    records = []
    for number, (stamp, log_time) in enumerate(zip(stamps, came, strict=True), 1):
        reached = SimpleNamespace(sec=0, nanosec=200_000_000)
        point = SimpleNamespace(positions=np.array([float(number)]), effort=np.empty(0), time_from_start=reached)
        message = SimpleNamespace(joint_names=["hinge"], points=[point])
        records.append(Record(int(stamp), int(log_time), message))
    return SimpleNamespace(records={JOINT_COMMANDS: records})


@pytest.mark.parametrize(
    ("delays_ms", "offset_ms", "time", "target"),
    [
        ([12, 12, 73, 12], 0, [0.012, 0.212, 0.473, 0.612], [1, 2, 3, 4]),
        ([12, 250, 50, 12], 0, [0.012, 0.45, 0.612], [1, 3, 4]),  # two came together
        ([0, 0, 0, 0], 0, [0.0, 0.2, 0.4, 0.6], [1, 2, 3, 4]),  # simulated time
        ([12, 12, 73, 12], 5000, [0.0, 0.2, 0.4, 0.6], [1, 2, 3, 4]),  # the recorder has another clock
    ],
)
def test_a_command_acts_when_it_came(delays_ms, offset_ms, time, target):
    commands = read_commands(recorded(delays_ms, offset_ms), ("hinge",), 0, 800_000_000, [])
    assert commands.time == pytest.approx(time) and commands.target[:, 0].tolist() == target
