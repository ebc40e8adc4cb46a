"""Stamps: close to the truth, never in the future, never repeated."""

import itertools

import numpy as np
import pytest

from hexapod_driver import status
from hexapod_driver.clock import BoardClock, RisingStamps

SECOND = 1_000_000_000


def _frames(seconds: float, drift: float = 0.0, seed: int = 1):
    """(board time in us, true ROS time in ns, arrival in ns) at 50 Hz, 2 to 30 ms late."""
    rng = np.random.default_rng(seed)
    for k in range(int(seconds * 50)):
        true = 100 * SECOND + k * SECOND // 50
        yield int(k * 20_000 * (1 + drift)), true, true + int((0.002 + 0.028 * rng.random()) * SECOND)


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_stamps_are_the_time_of_measurement_and_not_of_arrival(drift: float):
    clock = BoardClock()
    errors = []
    for board, true, arrival in _frames(30, drift):
        clock.observe(board, arrival)
        stamp = clock.stamp(board, arrival)
        assert stamp <= arrival
        errors.append(stamp - true)
    late = np.array(errors[100:]) / SECOND
    assert np.all(late > -0.001)
    assert np.all(late < 0.004)  # the least delay, 2 ms, and a little for noise and drift


def test_a_restarted_board_starts_the_mapping_over():
    clock = BoardClock()
    for board, _, arrival in _frames(5):
        clock.observe(board, arrival)
    clock.observe(1000, 200 * SECOND)
    assert clock.restarts == 1
    assert clock.stamp(1000, 200 * SECOND) == 200 * SECOND


def test_a_computers_clock_set_back_starts_the_mapping_over():
    clock = BoardClock()
    clock.observe(1_000_000, 100 * SECOND)
    clock.observe(1_020_000, 50 * SECOND)
    assert clock.restarts == 1
    assert clock.stamp(1_020_000, 50 * SECOND) == 50 * SECOND


def test_a_stall_of_the_link_moves_no_stamp():
    clock = BoardClock()
    clock.observe(1_000_000, 100 * SECOND)
    clock.observe(1_020_000, 102 * SECOND)
    assert clock.stamp(1_020_000, 102 * SECOND) == 100 * SECOND + 20_000_000
    assert clock.restarts == 0


def test_without_any_frame_the_arrival_is_all_there_is():
    assert BoardClock().stamp(5, 123) == 123


def test_stamps_rise_whatever_comes():
    stamps = RisingStamps()
    given = [10_000_000, 30_000_000, 30_000_000, 20_000_000, 50_000_000]
    out = [stamps.next(s) for s in given]
    assert all(a < b for a, b in itertools.pairwise(out))
    assert (out[0], out[1], out[4]) == (10_000_000, 30_000_000, 50_000_000)
    stamps.restart()
    assert stamps.next(5) == 5


def test_stamps_after_a_clock_was_set_back_tell_by_how_much_they_are_raised_until_it_catches_up():
    stamps = RisingStamps()
    behind = []
    for given in (10 * SECOND, 8 * SECOND, 9 * SECOND, 11 * SECOND):
        stamps.next(given)
        behind.append(stamps.behind_ns)
    assert behind == pytest.approx([0, 2 * SECOND, 1 * SECOND, 0], abs=10_000)
    assert status.clock(behind[2] * 1e-9).level == status.WARN
    assert status.clock(0.001).level == status.OK
