"""What may reach the servos, and when the robot must be limp."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcbi_contract.names import JOINT_LIMIT, JOINTS
from tcbi_contract.safety import CommandRefused, Limits, Mode, Safety, check_age, ordered_target

ZERO = (0.0,) * 18
LIMITS = Limits(max_speed=2.0, approach_speed=0.5)


def _ready(position: tuple[float, ...] = ZERO, now: float = 0.0) -> Safety:
    safety = Safety(LIMITS)
    safety.measured(now, position)
    return safety


def _active(position: tuple[float, ...] = ZERO) -> Safety:
    safety = _ready(position)
    safety.command(0.0, position, 0.2)
    return safety


def test_the_first_command_arms_from_where_the_joints_are():
    move = _ready((0.1,) * 18).command(0.0, (0.1,) * 18, 0.2)
    assert move.arm and move.start == (0.1,) * 18
    assert not _active().command(0.1, ZERO, 0.2).arm


def test_the_first_command_far_away_moves_slowly():
    move = _ready((-0.5,) * 18).command(0.0, (0.5,) * 18, 0.2)
    assert move.target == pytest.approx((-0.4,) * 18)
    assert move.limited == JOINTS


def test_the_approach_stays_slow_until_it_has_arrived_and_is_then_fast():
    safety = _ready((-0.5,) * 18)
    targets = []
    for k in range(8):
        targets.append(safety.command(0.2 * k, ZERO, 0.2).target[0])
        safety.measured(0.2 * k, (targets[-1],) * 18)
    assert targets[:5] == pytest.approx([-0.4, -0.3, -0.2, -0.1, 0.0], abs=1e-9)
    safety.measured(1.6, ZERO)
    assert safety.command(1.6, (0.3,) * 18, 0.2).target == pytest.approx((0.3,) * 18)


def test_a_commanded_jump_is_slowed_to_the_greatest_speed():
    safety = _active()
    move = safety.command(0.1, (0.5,) + (0.0,) * 17, 0.2)
    assert move.target[0] == pytest.approx(0.4)
    assert move.limited == ("lf_coxa",)


@given(st.lists(st.tuples(st.floats(0.005, 0.5), st.floats(0.02, 2.0), st.floats(-1, 1)), min_size=2, max_size=8))
def test_no_rhythm_of_commands_outruns_the_greatest_speed(commands: list[tuple[float, float, float]]):
    safety, now, ramp, ramp_begin = _active(), 1.0, None, 0.0
    for wait, duration, target in commands:
        safety.measured(now, ZERO)
        move = safety.command(now, (target,) * 18, duration)
        if ramp is not None:
            share = min((now - ramp_begin) / ramp.duration_s, 1)
            assert move.start[0] == pytest.approx(ramp.start[0] + share * (ramp.target[0] - ramp.start[0]), abs=1e-9)
        assert abs(move.target[0] - move.start[0]) <= 2.0 * duration + 1e-9
        ramp, ramp_begin, now = move, now, now + wait


@given(st.lists(st.floats(-1e6, 1e6), min_size=18, max_size=18), st.floats(0.02, 2.0))
def test_no_target_leaves_the_joint_range_or_breaks_the_speed(target: list[float], duration: float):
    safety = _active()
    move = safety.command(0.1, target, duration)
    assert all(abs(t) <= JOINT_LIMIT for t in move.target)
    assert all(abs(t - s) <= 2.0 * duration + 1e-9 for s, t in zip(move.start, move.target, strict=True))


def test_a_limp_robot_outside_the_range_is_brought_back_slowly():
    move = _ready((1.0,) * 18).command(0.0, (1.0,) * 18, 0.2)
    assert move.target == pytest.approx((0.9,) * 18)


def test_silence_of_two_control_periods_makes_it_limp_and_a_command_arms_it_again():
    safety = _active()
    safety.measured(0.39, ZERO)
    assert not safety.tick(0.4)
    assert safety.tick(0.401)
    assert safety.mode is Mode.LIMP and not safety.needs_reset
    assert not safety.tick(0.5)
    assert safety.command(0.5, ZERO, 0.2).arm


def test_a_reading_that_fails_to_come_makes_it_limp_though_commands_come():
    safety = _active()
    safety.command(0.3, ZERO, 0.2)
    assert safety.tick(0.41)
    assert safety.needs_reset
    safety.measured(0.5, ZERO)
    with pytest.raises(CommandRefused, match="reset_episode"):
        safety.command(0.5, ZERO, 0.2)


def test_no_command_before_the_joints_are_known():
    with pytest.raises(CommandRefused, match="not known"):
        Safety(LIMITS).command(0.0, ZERO, 0.2)
    with pytest.raises(CommandRefused, match="not known"):
        _ready().command(1.0, ZERO, 0.2)
    with pytest.raises(CommandRefused, match="not known"):
        _ready().begin_reset(1.0)


def test_an_emergency_stop_is_latched_until_released_and_then_needs_a_reset():
    safety = _active()
    safety.stop()
    assert safety.mode is Mode.STOPPED
    for refused in (lambda: safety.command(0.1, ZERO, 0.2), lambda: safety.begin_reset(0.1)):
        with pytest.raises(CommandRefused, match="emergency stop"):
            refused()
    assert safety.release() and not safety.release()
    assert safety.mode is Mode.LIMP
    with pytest.raises(CommandRefused, match="reset_episode"):
        safety.command(0.1, ZERO, 0.2)
    safety.begin_reset(0.1)
    assert safety.command(0.1, ZERO, 0.2, from_reset=True).arm


def test_a_lost_link_does_not_lift_an_emergency_stop():
    safety = _active()
    safety.stop()
    safety.go_limp("link lost", needs_reset=True)
    assert safety.mode is Mode.STOPPED
    assert safety.reason == "emergency stop"


def test_a_stop_during_a_reset_ends_the_reset():
    safety = _ready()
    safety.begin_reset(0.0)
    safety.command(0.0, ZERO, 0.2, from_reset=True)
    safety.stop()
    with pytest.raises(CommandRefused, match="emergency stop"):
        safety.command(0.1, ZERO, 0.2, from_reset=True)


def test_a_reset_keeps_others_from_commanding_and_then_holds():
    safety = _ready()
    assert safety.begin_reset(0.0) == ZERO
    safety.command(0.0, ZERO, 0.2, from_reset=True)
    with pytest.raises(CommandRefused, match="initial posture"):
        safety.command(0.1, ZERO, 0.2)
    with pytest.raises(CommandRefused, match="another reset"):
        safety.begin_reset(0.1)
    safety.hold(0.2)
    safety.measured(9.9, ZERO)
    assert not safety.tick(10.1)
    safety.measured(10.1, ZERO)
    assert safety.tick(10.3)


def test_after_the_first_command_a_held_posture_is_watched_as_usual():
    safety = _ready()
    safety.begin_reset(0.0)
    safety.command(0.0, ZERO, 0.2, from_reset=True)
    safety.hold(0.1)
    safety.command(0.2, ZERO, 0.2)
    safety.measured(0.6, ZERO)
    assert safety.tick(0.61)


def test_a_reset_from_a_moving_robot_begins_at_its_last_commanded_position_and_is_slow():
    safety = _active()
    safety.command(0.1, (0.3,) * 18, 0.2)
    assert safety.begin_reset(0.3) == pytest.approx((0.3,) * 18)
    assert safety.command(0.3, ZERO, 0.2, from_reset=True).target == pytest.approx((0.2,) * 18)


@pytest.mark.parametrize("duration", [0.0, -1.0, 0.019, 2.1, math.inf, math.nan])
def test_a_ramp_of_impossible_duration_is_refused(duration: float):
    with pytest.raises(CommandRefused, match="time_from_start"):
        _active().command(0.1, ZERO, duration)


def test_names_decide_the_order():
    values = [0.01 * i for i in range(18)]
    assert ordered_target(list(reversed(JOINTS)), list(reversed(values))) == tuple(values)


@pytest.mark.parametrize(
    ("names", "values", "words"),
    [
        (JOINTS[:-1], ZERO[:-1], "missing.*rr_tibia"),
        ((*JOINTS[:-1], "tail"), ZERO, "unknown.*tail"),
        ((*JOINTS[:-1], "lf_coxa"), ZERO, "twice.*lf_coxa"),
        ((*JOINTS, "tail"), (*ZERO, 0.0), "unknown.*tail"),
        (JOINTS, ZERO[:-1], "17 positions"),
        ((), (), "missing"),
        (JOINTS, (math.nan, *ZERO[1:]), "lf_coxa=nan"),
        (JOINTS, (math.inf, *ZERO[1:]), "lf_coxa=inf"),
        (JOINTS, (*ZERO[1:], -math.inf), "rr_tibia=-inf"),
    ],
)
def test_wrong_names_and_numbers_are_refused(names, values, words: str):
    with pytest.raises(CommandRefused, match=words):
        ordered_target(names, values)


def test_commands_from_the_past_the_future_or_out_of_order_are_refused():
    check_age(99.7, 100.0, 0.0)
    check_age(0.0, 100.0, 99.9)
    check_age(99.9, 100.0, 99.9)
    with pytest.raises(CommandRefused, match=r"0\.500 s old"):
        check_age(99.5, 100.0, 0.0)
    with pytest.raises(CommandRefused, match=r"-5\.000 s old"):
        check_age(105.0, 100.0, 0.0)
    with pytest.raises(CommandRefused, match="older than the last"):
        check_age(99.8, 100.0, 99.9)
