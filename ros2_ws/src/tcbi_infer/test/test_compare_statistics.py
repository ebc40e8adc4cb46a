"""Noise floors, replicates, splits, guards and locations: each against a case whose answer is known."""

import dataclasses

import numpy as np
import pytest

from tcbi_infer.compare.clocks import Following
from tcbi_infer.compare.guards import check_recording, guard, to_mend
from tcbi_infer.compare.noise import autocorrelation_time, from_fast_changes, noise_floor
from tcbi_infer.compare.replicates import SURE_KINDS, Replicates, find_replicates, split
from tcbi_infer.compare.signals import JOINT, Layout, reference, window_mean
from tcbi_infer.compare.wiring import unjudged
from tcbi_infer.diagnose.paired import LEVEL, level
from tcbi_infer.spikes import broken_readings, without_spikes
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.rigs import load_rig

TIME = np.arange(1, 251) / 50.0


def recording(
    name: str = "a",
    target: np.ndarray | None = None,
    lag: float = 0.06,
    policy: str = "gait:sine",
    jitter: float = 0.0,
    gain: float = 0.97,
) -> Measurement:
    """A hexapod whose joints follow their commands after a lag, all but a little of the way."""
    rig = load_rig("hexapod")
    t = np.arange(25) * 0.2
    if target is None:
        phase = np.linspace(0, 5, 18)
        target = 0.3 * np.sin(2 * np.pi * np.linspace(0.3, 0.6, 18) * t[:, None] + phase)
    shifted = t + jitter * np.random.default_rng(len(name)).random(25)
    m = Measurement(
        rollout_id=name,
        rig="hexapod",
        scenario=Scenario("balance", 5.0),
        policy_id=policy,
        source="driver",
        commands=Commands(shifted, target),
        joint_names=rig.joint_names,
        foot_names=rig.foot_names,
        time=TIME,
        joint_position=np.zeros((250, 18)),
    )
    return dataclasses.replace(m, joint_position=gain * reference(m, TIME - lag))


def test_jitter_of_the_command_stream_does_not_hide_a_replicate():
    sets = find_replicates([recording("a"), recording("bb", jitter=0.01), recording("c", 0.1 * np.ones((25, 18)))])
    assert [s.members for s in sets] == [(0, 1), (2,)]


def test_another_slope_is_no_replicate():
    tilted = dataclasses.replace(recording("b"), scenario=Scenario("balance", 5.0, slope_roll=0.1))
    assert len(find_replicates([recording("a"), tilted])) == 2


def test_the_same_motion_on_another_bench_is_the_same_kind():
    other = dataclasses.replace(recording("b"), scenario=Scenario("balance", 5.0, constants=(("kp", 200.0),)))
    sets = find_replicates([recording("a"), other, recording("c", np.linspace(0, 0.4, 25)[:, None] * np.ones(18))])
    assert [s.kind for s in sets] == [0, 0, 1]


def test_no_kind_of_motion_is_in_two_parts_of_a_split():
    sets = [Replicates((i,), i % 7) for i in range(21)]
    parts = [*split(sets).folds, split(sets).sealed]
    kinds = [{sets[i].kind for i in part} for part in parts]
    assert sum(len(k) for k in kinds) == len(set().union(*kinds)) == 7
    assert sorted(i for part in parts for i in part) == list(range(21))
    assert split(sets).sealed


def test_few_kinds_leave_nothing_sealed():
    for count, sealed in ((3, 0), (5, 0), (6, 0), (7, 1), (10, 2)):
        parts = split([Replicates((i,), i) for i in range(count)])
        assert (len(parts.sealed), len(parts.folds)) == (sealed, count - sealed)
    assert level(SURE_KINDS - 1) < level(SURE_KINDS) == LEVEL, "one more would be sealed only where 5 % can be held"


def test_the_floor_of_replicates_is_their_noise_whatever_the_model_gets_wrong():
    layout = Layout.of([recording()])
    rng = np.random.default_rng(0)
    truth = 10 * np.sin(TIME)[None, :, None] * np.ones((2, 1, 18))
    measured = truth + rng.normal(0, 0.2, truth.shape)
    floor = noise_floor(layout, measured, measured - 5.0, [Replicates((0, 1), 0)])
    assert floor.from_replicates
    assert floor.values == pytest.approx(0.2, rel=0.25)
    assert np.mean(floor.values) == pytest.approx(0.2, rel=0.05)


def test_without_replicates_the_floor_comes_from_fast_changes_and_says_so():
    layout = Layout.of([recording()])
    residual = 3 * np.sin(TIME)[None, :, None] + np.random.default_rng(0).normal(0, 0.2, (1, 250, 18))
    floor = noise_floor(layout, residual, residual, [Replicates((0,), 0)])
    assert not floor.from_replicates and "estimated from fast changes" in floor.statement
    assert np.mean(from_fast_changes(residual)) == pytest.approx(0.2, rel=0.1)


def test_the_floor_says_of_how_many_motions_it_is():
    layout, rng = Layout.of([recording()]), np.random.default_rng(0)
    measured = rng.normal(0, 0.2, (5, 250, 18))
    few, more = ([Replicates((0, 1), 0), *rest] for rest in ([Replicates((k,), k) for k in (2, 3, 4)], []))
    once = noise_floor(layout, measured, measured, few)
    assert (once.repeated, once.motions) == (1, 4)
    assert once.statement.endswith("commands. 1 of 4 motions was repeated; its scatter stands for all.")
    assert noise_floor(layout, measured[:2], measured[:2], more).statement.endswith("repeated the same commands.")


def test_a_simulation_that_repeats_itself_to_the_last_bit_makes_no_floor_and_is_told():
    layout = Layout.of([recording()])
    measured = np.random.default_rng(0).normal(0, 0.2, (1, 250, 18)).repeat(3, axis=0)
    floor = noise_floor(layout, measured, measured, [Replicates((0, 1, 2), 0)])
    assert not floor.from_replicates and floor.values == pytest.approx(0.2, rel=0.25)
    measured[2] += np.random.default_rng(1).normal(0, 0.2, (250, 18))
    floor = noise_floor(layout, measured, measured, [Replicates((0, 1, 2), 0)])
    assert floor.from_replicates and floor.values == pytest.approx(0.2 / np.sqrt(2), rel=0.25)
    (finding,) = guard([recording("a"), recording("b"), recording("c", gain=0.9)])
    assert finding.startswith("b is a again to the last bit: ")


def test_autocorrelation_time_of_a_first_order_process_is_the_textbook_value():
    rng = np.random.default_rng(1)
    x = np.zeros((8, 4000, 1))
    for t in range(1, 4000):
        x[:, t] = 0.8 * x[:, t - 1] + rng.normal(size=(8, 1))
    assert autocorrelation_time(x) == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.25)
    assert autocorrelation_time(rng.normal(size=(8, 4000, 1))) == pytest.approx(1.0, abs=0.3)


def test_a_window_mean_is_the_mean_of_its_window():
    values = np.arange(10.0)[:, None]
    assert window_mean(values, 3)[4, 0] == 4.0
    assert window_mean(values, 3)[0, 0] == 0.5


def test_a_sound_recording_raises_no_finding():
    assert check_recording(recording()) == []


def test_what_the_reader_left_out_of_a_bag_is_told_before_any_figure():
    cut = dataclasses.replace(recording(), rollout_id="cut", notes=("no imu/data: no attitude is compared",))
    assert guard([cut]) == ["no imu/data: no attitude is compared."]
    assert guard([recording(gain=0.96), cut]) == ["no imu/data: no attitude is compared (cut)."]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: q * np.where(np.arange(18) == 4, -1, 1), "lm_femur moves against its command"),
        (lambda q: q[:, [8, *range(1, 8), 0, *range(9, 18)]], "lf_coxa and lr_tibia follow each other's commands"),
        (lambda q: 2048 + q * 651.9, "raw encoder counts"),
    ],
)
def test_wiring_and_unit_mistakes_are_named(change, words):
    sound = recording()
    broken = dataclasses.replace(sound, joint_position=change(sound.joint_position))
    assert any(words in finding for finding in check_recording(broken))


def test_a_joint_that_stands_still_while_it_is_asked_to_move_is_named():
    sound = recording()
    assert check_recording(sound) == []
    position = sound.joint_position.copy()
    position[80:, 4] = position[80, 4]
    (finding,) = check_recording(dataclasses.replace(sound, joint_position=position))
    assert finding.startswith(f"{sound.joint_names[4]} stays where it is from 1.6") and "servo dead" in finding


def test_the_way_to_the_first_command_is_no_motion_that_a_frozen_joint_missed():
    sound = recording()
    target, position = sound.commands.target.copy(), sound.joint_position.copy()
    target[:, 4], position[:, 4] = 0.9, 0.0
    still = dataclasses.replace(sound, joint_position=position, commands=Commands(sound.commands.time, target))
    assert not any("stays where it is" in finding for finding in check_recording(still))


@pytest.mark.parametrize(("stands_at", "told"), [(-0.85, True), (0.85, False), (-0.5, False)])
def test_a_joint_that_stands_at_the_opposite_of_its_command_may_be_mirrored(stands_at, told):
    sound = recording()
    target, position = sound.commands.target.copy(), sound.joint_position.copy()
    target[:, 4], position[:, 4] = 0.9, stands_at
    still = dataclasses.replace(sound, joint_position=position, commands=Commands(sound.commands.time, target))
    name = sound.joint_names[4]
    expected = [f"{name} stands at the opposite of its command: its sign may be mirrored"] * told
    assert [f for f in check_recording(still) if "mirrored" in f] == expected
    assert unjudged([still]) == (name,) and unjudged([still, sound]) == () == unjudged([sound])


def test_a_joint_is_mirrored_where_it_is_at_the_opposite_of_its_command_though_no_lag_is_told(monkeypatch):
    """As the elbow of an arm that follows slow ramps, in which a lag shows too little."""
    sound = recording()
    target, position = 0.5 + 0.1 * sound.commands.target, 0.5 + 0.1 * sound.joint_position
    position *= np.where(np.arange(18) == 4, -1, 1)
    slow = dataclasses.replace(sound, joint_position=position, commands=Commands(sound.commands.time, target))
    monkeypatch.setattr(Following, "lag", float("nan"))
    assert [f for f in check_recording(slow) if "mirrored" in f] == [
        f"{sound.joint_names[4]} moves against its command: its sign may be mirrored"
    ]


def test_a_broken_reading_is_named_and_taken_for_no_other_unit():
    sound = recording()
    position = sound.joint_position.copy()
    position[100, 3] = 300.0
    broken = dataclasses.replace(sound, joint_position=position)
    (finding,) = guard([broken])
    assert finding.startswith(f"1 reading of {sound.joint_names[3]}, the first at ") and "left out" in finding
    mended = without_spikes(broken)
    assert np.abs(mended.joint_position - sound.joint_position).max() < 0.1
    ((field, begin, end),) = mended.gaps
    assert field == "joint_position" and begin < sound.time[100] < end
    assert without_spikes(sound) is sound


def test_commands_that_were_taken_for_degrees_are_named():
    sound = recording()
    tiny = dataclasses.replace(sound.commands, target=np.radians(sound.commands.target))
    wrong = dataclasses.replace(sound, commands=tiny)
    (finding,) = guard([wrong])
    assert "57 times as far as their commands" in finding and "commands were scaled" in finding
    assert to_mend([wrong])
    resting = dataclasses.replace(wrong, joint_position=np.radians(sound.joint_position))
    assert not to_mend([resting]), "nothing tells a small motion from one in another unit"


def test_a_reading_that_wraps_round_is_named_as_that():
    sound = recording()
    position = sound.joint_position.copy()
    position[100:, 3] += 2 * np.pi
    (finding,) = to_mend([dataclasses.replace(sound, joint_position=position)])
    assert finding.startswith(f"{sound.joint_names[3]} jumps by a whole turn at 2.02 s")


def test_what_is_often_far_off_is_no_broken_reading():
    sound = recording()
    position = sound.joint_position.copy()
    position[10::10, 3] += 1.0
    assert not broken_readings(dataclasses.replace(sound, joint_position=position)).any()


def test_an_echo_of_the_commands_is_named():
    assert any("echoes commands" in f for f in check_recording(recording(lag=0.0, gain=1.0)))


def test_joints_that_lead_their_commands_point_at_the_clocks():
    assert any("lead their commands" in f for f in guard([recording(lag=-0.15)]))


def test_a_gap_in_the_samples_is_named():
    m = recording()
    keep = (m.time < 2) | (m.time > 3)
    cut = dataclasses.replace(m, time=m.time[keep], joint_position=m.joint_position[keep])
    assert "No samples from 1.98 to 3.02 s: left out of every error" in check_recording(cut)


def test_layout_leaves_out_what_was_not_measured():
    layout = Layout.of([recording()])
    assert {c.group for c in layout.channels} == {JOINT}
