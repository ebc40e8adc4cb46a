"""The simulated clock moves by commands alone, stops where the episode ends, and waits no longer than it may."""

import itertools

import pytest

from tcbi_sim.lockstep import SECOND, WINDOW, LockstepClock


@pytest.fixture
def clock() -> LockstepClock:
    return LockstepClock(timeout_s=2.0)


def run(clock: LockstepClock, windows: int, wall_s: float = 0.0) -> None:
    for _ in range(windows):
        assert clock.may_run(clock.now)
        clock.advance(wall_s)


def test_a_command_of_the_present_runs_one_window_and_others_none(clock):
    assert clock.may_run(clock.now)
    before = clock.now
    clock.advance(0.0)
    assert clock.now == before + WINDOW
    assert not clock.may_run(before)
    assert not clock.may_run(clock.now + WINDOW)
    assert clock.strays == 2


def test_episodes_start_at_whole_seconds_later_than_anything_before(clock):
    starts = []
    for windows in (0, 1, 7, 25):
        starts.append(clock.reset(None, 0.0))
        assert starts[-1] % SECOND == 0
        run(clock, windows)
    assert all(b > a for a, b in itertools.pairwise(starts))
    assert clock.reset(None, 0.0) > starts[-1] + 25 * WINDOW


def test_a_late_last_command_changes_neither_the_end_nor_the_next_start(clock):
    starts = []
    for late in (False, True):
        clock = LockstepClock(timeout_s=2.0)
        start = clock.reset(8 * SECOND, 0.0)
        assert clock.begin(start, 0.0)
        run(clock, 40)
        assert clock.now == start + 8 * SECOND
        assert not clock.may_run(clock.now)
        clock.end()
        if late and clock.may_run(clock.now):
            clock.advance(0.0)
        starts.append(clock.reset(8 * SECOND, 0.0))
    assert starts[0] == starts[1]


def test_the_wait_is_bounded_in_an_episode_only(clock):
    start = clock.reset(8 * SECOND, wall_s=10.0)
    assert not clock.overdue(100.0)
    clock.begin(start, wall_s=100.0)
    assert not clock.overdue(101.9)
    assert clock.overdue(102.0)
    clock.skip()
    clock.advance(102.0)
    assert clock.missed == 1
    assert not clock.overdue(103.0)


def test_an_end_that_nobody_announces_holds_the_clock_for_the_timeout_only(clock):
    clock.begin(clock.reset(WINDOW, 0.0), 0.0)
    run(clock, 1, wall_s=5.0)
    assert clock.at_end and not clock.overdue(6.0)
    assert clock.overdue(7.0)
    clock.skip()
    assert not clock.at_end and clock.missed == 0
    run(clock, 1)


def test_an_old_latched_begin_starts_no_episode(clock):
    assert not clock.begin(5 * SECOND, 0.0)
    start = clock.reset(None, 0.0)
    assert not clock.begin(start - SECOND, 0.0)
    assert not clock.in_episode
