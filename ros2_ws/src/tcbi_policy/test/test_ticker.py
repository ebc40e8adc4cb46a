"""When the policy acts: on stamps alone, and never on old data."""

import numpy as np
import pytest

from tcbi_policy.ticker import PERIOD, SensorLoss, Tick, Ticker

MS = 1_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def feed(ticker: Ticker, stamp: int, attitude: bool = True, wall: float = 0.0) -> list[Tick]:
    """One sample of each stream; the ticks that came due."""
    ticker.add_joints(stamp, np.full(18, stamp / 1e9), wall)
    ticks = [ticker.due(True)]
    if attitude:
        ticker.add_attitude(stamp, LEVEL, wall)
        ticks.append(ticker.due(True))
    return [tick for tick in ticks if tick is not None]


def started(sim_time: bool = False, at: int = 1000 * MS) -> Ticker:
    ticker = Ticker(sim_time, 0.4)
    ticker.enable(0.0)
    assert len(feed(ticker, at)) == 1
    return ticker


def test_ticks_lie_on_multiples_of_the_control_period_and_take_the_values_at_them() -> None:
    ticker = Ticker(False, 0.4)
    ticker.enable(0.0)
    ticks = [tick for k in range(60) for tick in feed(ticker, 1_007 * MS + 20 * k * MS)]
    assert [tick.time for tick in ticks] == [1200 * MS + k * PERIOD for k in range(5)]
    assert [tick.joint_position[0] for tick in ticks] == pytest.approx([tick.time / 1e9 for tick in ticks])
    assert [tick.elapsed for tick in ticks] == pytest.approx([0.2 * k for k in range(5)])


def test_an_enabled_policy_ticks_at_the_present_where_a_simulated_clock_stands() -> None:
    ticker = Ticker(True, 0.4)
    feed(ticker, 3000 * MS)
    ticker.enable(100.0)
    tick = ticker.due(True)
    assert tick is not None and tick.time == 3000 * MS
    assert ticker.due(True) is None


def test_sensors_are_heard_once_each_that_is_needed_has_come() -> None:
    ticker = Ticker(False, 0.4)
    assert not ticker.heard(needs_attitude=False)
    feed(ticker, 1000 * MS, attitude=False)
    assert ticker.heard(needs_attitude=False) and not ticker.heard(needs_attitude=True)
    feed(ticker, 1020 * MS)
    assert ticker.heard(needs_attitude=True)


def test_in_real_time_samples_from_before_a_silence_are_no_present() -> None:
    ticker = Ticker(False, 0.4)
    feed(ticker, 3000 * MS, wall=0.0)
    ticker.enable(100.0)
    assert ticker.due(True) is None


def test_no_tick_comes_before_the_rollout_begins() -> None:
    ticker = Ticker(True, 0.4)
    feed(ticker, 9000 * MS)
    ticker.not_before(11_000 * MS)
    ticker.enable(0.0)
    assert ticker.due(True) is None
    assert [tick.time for tick in feed(ticker, 11_000 * MS)] == [11_000 * MS]


@pytest.mark.parametrize(("stood_ms", "reset_ms"), [(1000, 2000), (1800, 2000), (2400, 3000), (2400, 1000)])
def test_a_reset_simulation_starts_the_ticks_anew(stood_ms: int, reset_ms: int) -> None:
    """In lockstep a reset jumps to the next whole second; another simulation sets its clock back."""
    ticker = started(sim_time=True)
    for stamp in range(1020, stood_ms + 1, 20):
        feed(ticker, stamp * MS)
    ticks = feed(ticker, reset_ms * MS)
    assert [(tick.time, tick.elapsed) for tick in ticks] == [(reset_ms * MS, 0.0)]


@pytest.mark.parametrize("last_ms", [1000, 1140])
@pytest.mark.parametrize("next_ms", [1520, 1800, 2200, 3000])
def test_a_gap_in_simulated_time_stops_the_motion_also_where_it_ends_at_a_tick(last_ms: int, next_ms: int) -> None:
    ticker = started(sim_time=True)
    for stamp in range(1020, last_ms + 1, 20):
        feed(ticker, stamp * MS)
    with pytest.raises(SensorLoss, match="joint_states is"):
        for k in range(10):
            feed(ticker, (next_ms + 20 * k) * MS)
    assert not ticker.enabled


def test_a_jump_of_a_simulated_clock_is_no_gap_to_a_policy_that_rests_or_whose_rollout_begins_there() -> None:
    resting = started(sim_time=True)
    resting.disable()
    feed(resting, 7770 * MS)
    resting.enable(0.0)
    assert [tick.time for tick in feed(resting, 7800 * MS)] == [7800 * MS]
    begun = started(sim_time=True)
    begun.not_before(7800 * MS)
    assert [(tick.time, tick.elapsed) for tick in feed(begun, 7800 * MS)] == [(7800 * MS, 0.0)]


def test_a_tick_waits_for_the_attitude() -> None:
    ticker = started()
    for k in range(1, 10):
        feed(ticker, 1000 * MS + 20 * k * MS)
    assert feed(ticker, 1200 * MS, attitude=False) == []
    ticker.add_attitude(1200 * MS, LEVEL, 0.0)
    assert ticker.due(True) is not None


def test_a_missing_attitude_stops_the_motion() -> None:
    ticker = started()
    with pytest.raises(SensorLoss, match="imu/data"):
        for k in range(1, 40):
            feed(ticker, 1000 * MS + 20 * k * MS, attitude=False)
    assert not ticker.enabled
    assert feed(ticker, 3000 * MS) == []


def test_a_gap_in_the_joint_angles_stops_the_motion() -> None:
    ticker = started()
    for k in range(1, 3):
        feed(ticker, 1000 * MS + 20 * k * MS)
    with pytest.raises(SensorLoss, match="joint_states is 160 ms old"):
        feed(ticker, 1210 * MS)


def test_one_late_sample_within_a_tenth_of_a_second_is_still_used() -> None:
    ticker = started()
    feed(ticker, 1120 * MS)
    ticks = feed(ticker, 1205 * MS)
    assert [tick.time for tick in ticks] == [1200 * MS]
    assert ticks[0].joint_position[0] == pytest.approx(1.2)


def test_a_node_that_was_held_up_skips_to_the_present_and_counts() -> None:
    ticker = started()
    for k in range(1, 50):
        ticker.add_joints(1000 * MS + 20 * k * MS, np.zeros(18), 0.0)
        ticker.add_attitude(1000 * MS + 20 * k * MS, LEVEL, 0.0)
    tick = ticker.due(True)
    assert tick is not None and tick.time == 1800 * MS
    assert ticker.missed == 3


def test_silence_stops_in_real_time_and_is_nothing_where_the_clock_may_stand() -> None:
    for sim_time, silent in ((False, True), (True, False)):
        ticker = started(sim_time)
        assert ticker.silence(True, 0.3) == ""
        assert bool(ticker.silence(True, 0.5)) is silent


def test_silence_names_the_stream() -> None:
    ticker = started()
    ticker.add_joints(1020 * MS, np.zeros(18), 1.0)
    assert ticker.silence(True, 1.1) == "imu/data silent for more than 0.4 s"
    assert ticker.silence(False, 1.1) == ""


def test_a_sample_that_repeats_a_stamp_is_dropped() -> None:
    ticker = started()
    ticker.add_joints(1000 * MS, np.ones(18), 0.0)
    feed(ticker, 1100 * MS)
    ticks = feed(ticker, 1200 * MS)
    assert len(ticks) == 1 and ticks[0].joint_position[0] == pytest.approx(1.2)


def test_a_rested_policy_never_ticks() -> None:
    ticker = started()
    ticker.disable()
    assert feed(ticker, 1200 * MS) == []
    assert ticker.silence(True, 100.0) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_attitude_between_two_samples_is_a_rotation_between_theirs(sign: float) -> None:
    ticker = Ticker(False, 0.4)
    ticker.enable(0.0)
    for stamp, angle in ((1190 * MS, 0.2), (1210 * MS, 0.4)):
        ticker.add_joints(stamp, np.zeros(18), 0.0)
        turned = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
        ticker.add_attitude(stamp, turned * (sign if angle > 0.3 else 1.0), 0.0)
    tick = ticker.due(True)
    assert tick is not None and tick.attitude == pytest.approx([np.cos(0.15), 0.0, np.sin(0.15), 0.0], abs=1e-9)


def test_over_a_gap_nothing_is_drawn() -> None:
    ticker = Ticker(False, 0.4)
    ticker.enable(0.0)
    feed(ticker, 1160 * MS)
    (tick,) = feed(ticker, 1290 * MS)
    assert (tick.time, tick.joint_position[0]) == (1200 * MS, pytest.approx(1.16))
