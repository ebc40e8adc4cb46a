"""Progress: the time left is that of the work which is left, or absent."""

import pytest

from tcbi_bringup.progress import Estimate, Work


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_the_start_up_is_no_part_of_the_estimate(clock):
    estimate = Estimate(clock)
    clock.now += 60.0  # before anything was told
    estimate.tell(0.0)
    assert estimate.left_s() is None
    clock.now += 10.0
    estimate.tell(0.25)
    assert estimate.left_s() == pytest.approx(30.0)


def test_what_an_earlier_run_had_done_tells_no_speed(clock):
    estimate = Estimate(clock)
    estimate.tell(0.8)
    assert estimate.left_s() is None
    clock.now += 10.0
    estimate.tell(0.9)
    assert estimate.left_s() == pytest.approx(10.0)


def test_the_time_left_runs_down_between_two_tellings_and_is_gone_where_it_has_run_out(clock):
    estimate = Estimate(clock)
    estimate.tell(0.0)
    clock.now += 85.0
    estimate.tell(0.85)
    assert estimate.left_s() == pytest.approx(15.0)
    clock.now += 10.0
    estimate.tell(0.85)  # another stage, nothing more is done
    assert estimate.left_s() == pytest.approx(5.0)
    clock.now += 10.0
    assert estimate.left_s() is None


def test_who_knows_better_is_believed_and_may_know_nothing(clock):
    estimate = Estimate(clock)
    estimate.tell(0.1, left_s=20.0)
    clock.now += 5.0
    assert estimate.left_s() == pytest.approx(15.0)
    estimate.tell(0.2, left_s=float("nan"))
    assert estimate.left_s() is None


def test_little_of_the_work_tells_no_speed(clock):
    estimate = Estimate(clock)
    estimate.tell(0.0)
    clock.now += 1.0
    estimate.tell(0.01)
    assert estimate.left_s() is None


@pytest.mark.parametrize(
    ("total", "unit", "done", "shown"),
    [(1.0, "", 0.129, "12 %"), (81_920, "", 20_480, "25 %"), (8, "rollouts", 3, "3 of 8 rollouts"), (None, "", 3, "3"),
     (None, "", 0, ""), (1.0, "", 0.999, "99 %"), (1.0, "", 1.5, "100 %")],
)  # fmt: skip
def test_a_share_is_shown_in_per_cent_and_pieces_by_their_name(total, unit, done, shown):
    work = Work("working", total, unit)
    work.advance(done=done)
    assert work.amount() == shown
