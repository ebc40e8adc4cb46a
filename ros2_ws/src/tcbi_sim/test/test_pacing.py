"""Stamps of a real-time simulation lie on a grid, strictly increase, and follow the clock after hold-ups and resets."""

from hypothesis import given
from hypothesis import strategies as st

from tcbi_sim.pacing import MAX_DRIFT_NS, MAX_LAG_NS, Pacer

PERIOD = 20_000_000


def stamps(pacer: Pacer, steady: int, ros: int) -> list[int]:
    return [pacer.next_stamp() for _ in range(pacer.due(steady, ros))]


def test_jittering_calls_give_every_sample_once_on_the_grid():
    pacer = Pacer(PERIOD)
    zero = pacer.restart(1_000, 5_000_000_000)
    given_stamps = []
    for step, jitter in enumerate([0, 3, -4, 9, 1, 15, 0, 0, 2], start=1):
        given_stamps += stamps(pacer, 1_000 + step * PERIOD + jitter * 1_000_000, 5_000_000_000 + step * PERIOD)
    assert given_stamps == [zero + k * PERIOD for k in range(1, len(given_stamps) + 1)]
    assert len(given_stamps) == 9
    assert pacer.slips == 0


def test_a_short_delay_is_caught_up_and_a_long_one_is_jumped_over():
    pacer = Pacer(PERIOD)
    zero = pacer.restart(0, 0)
    assert len(stamps(pacer, MAX_LAG_NS, MAX_LAG_NS)) == MAX_LAG_NS // PERIOD
    late = 60_000_000_000
    assert stamps(pacer, late, late) == []
    assert pacer.slips == 1
    assert stamps(pacer, late + PERIOD, late + PERIOD) == [zero + late + PERIOD]


def test_a_ros_clock_set_forward_is_followed_at_once():
    pacer = Pacer(PERIOD)
    pacer.restart(0, 0)
    jump = 3_600_000_000_000
    stamps(pacer, PERIOD, PERIOD + jump)
    assert stamps(pacer, 2 * PERIOD, 2 * PERIOD + jump) == [2 * PERIOD + jump]


def test_a_ros_clock_set_back_is_followed_at_the_next_reset_and_not_before():
    pacer = Pacer(PERIOD)
    begin, back = 10**18, 2_000_000_000
    pacer.restart(0, begin)
    seen = stamps(pacer, PERIOD, begin + PERIOD)
    seen += stamps(pacer, 2 * PERIOD, begin + 2 * PERIOD - back)
    assert seen == [begin + PERIOD, begin + 2 * PERIOD]
    assert pacer.restart(3 * PERIOD, begin + 3 * PERIOD - back) == begin + 3 * PERIOD - back
    slightly = begin + 3 * PERIOD - back - MAX_LAG_NS // 2
    assert pacer.restart(3 * PERIOD, slightly) == begin + 4 * PERIOD - back, (
        "as far as jitter may be, stamps still rise"
    )


@given(
    st.lists(st.tuples(st.integers(0, 2 * MAX_LAG_NS), st.integers(-3 * MAX_DRIFT_NS, 3 * MAX_DRIFT_NS), st.booleans()))
)
def test_stamps_rise_between_resets_and_fall_there_only_to_a_clock_that_was_set_back(steps):
    pacer = Pacer(PERIOD)
    steady, shift, last = 0, 0, pacer.restart(0, 10**18)
    for delta, jump, reset in steps:
        steady, shift = steady + delta, shift + jump
        ros = 10**18 + steady + shift
        if reset:
            stamp = pacer.restart(steady, ros)
            assert stamp > last or 0 <= stamp - ros < PERIOD
            assert stamp % PERIOD == 0
            last = stamp
        for stamp in stamps(pacer, steady, ros):
            assert stamp > last and stamp % PERIOD == 0
            last = stamp


def test_a_command_falls_into_the_coming_sample():
    pacer = Pacer(PERIOD)
    pacer.restart(0, 0)
    stamps(pacer, 5 * PERIOD, 5 * PERIOD)
    assert pacer.since_last(5 * PERIOD + 7_000_000) == 0.007
    assert pacer.since_last(9 * PERIOD) == 0.02
