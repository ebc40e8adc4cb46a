"""The slow move of a reset: done when the joints rest, failed when one rests too far away."""

import pytest

from hexapod_driver.posture import PostureGoal, PostureMove

ZERO = (0.0,) * 18
FAR = (0.4,) * 18


def _move(tolerance: float = 0.1, rest_s: float = 0.6) -> PostureMove:
    return PostureMove(PostureGoal(ZERO, tolerance, rest_s), FAR, 0.5, 0.0, lambda *_: None)


def test_it_takes_the_time_that_the_speed_asks_for():
    move = _move()
    assert move.outcome(0.9, ZERO) is None  # 0.4 rad at 0.5 rad/s in ramps of 0.2 s, and one more
    assert move.outcome(1.0, ZERO) is None
    assert move.outcome(1.61, ZERO) == (True, "at rest, lf_coxa is farthest from the posture, by 0.000 rad")


def test_it_waits_for_joints_that_still_move():
    move = _move()
    for k in range(20):
        assert move.outcome(1.0 + 0.1 * k, (0.02 * (k % 2),) * 18) is None


def test_how_long_joints_rest_can_be_set():
    hasty, patient = _move(rest_s=0.2), _move(rest_s=2.0)
    for move in (hasty, patient):
        move.outcome(1.0, ZERO)
    assert (hasty.outcome(1.21, ZERO) or (False, ""))[0]
    assert patient.outcome(2.9, ZERO) is None


def test_a_blocked_joint_fails_and_is_named():
    move = _move()
    stuck = (0.0,) * 7 + (0.3,) + (0.0,) * 10
    move.outcome(1.0, stuck)
    success, text = move.outcome(1.7, stuck) or (True, "")
    assert not success
    assert "lr_femur rests 0.300 rad" in text


def test_a_leg_that_sags_a_little_is_accepted():
    move = _move(0.35)
    sagging = (0.0,) * 7 + (0.3,) + (0.0,) * 10
    move.outcome(1.0, sagging)
    assert (move.outcome(1.7, sagging) or (False, ""))[0]


def test_joints_that_never_rest_fail():
    move = _move()
    outcomes = [move.outcome(1.0 + 0.1 * k, (0.05 * (k % 2),) * 18) for k in range(60)]
    assert outcomes[-1] is not None and not outcomes[-1][0]


def test_ramps_are_due_five_times_a_second():
    move = _move()
    due = [k for k in range(101) if move.due(0.01 * k)]
    assert due == pytest.approx([0, 20, 40, 60, 80, 100], abs=1)
