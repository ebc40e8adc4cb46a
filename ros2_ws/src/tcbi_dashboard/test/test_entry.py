"""What may be typed into a field for a number."""

import pytest

from tcbi_dashboard.entry import Allowed
from tcbi_dashboard.errors import DashboardError

SLOPE = Allowed(-30, 30, unset="drawn")
COUNT = Allowed(1, 1000, whole=True)


@pytest.mark.parametrize(("typed", "meant"), [("30", 30.0), ("-12.5", -12.5), ("1,5", 1.5), (" 0 ", 0.0), ("", None)])
def test_what_is_allowed_is_taken_as_it_was_typed(typed, meant):
    assert SLOPE.read(typed) == meant and SLOPE.fault(typed) is None


@pytest.mark.parametrize("typed", ["95", "-30.01", "steep", "-", "1e", "nan", "inf"])
def test_nothing_is_moved_into_the_limits_and_the_mark_says_what_is_allowed(typed):
    with pytest.raises(DashboardError):
        SLOPE.read(typed)
    assert SLOPE.fault(typed) == "allowed: -30 to 30, or empty (drawn)"


@pytest.mark.parametrize("typed", ["1.5", "-3", "0", "1001", "", "inf"])
def test_a_count_is_whole_and_there(typed):
    assert COUNT.fault(typed) == "allowed: whole numbers from 1 to 1000"
    assert COUNT.read("1000") == 1000.0


def test_large_limits_are_written_out():
    assert str(Allowed(0, 2**32 - 1, whole=True)) == "allowed: whole numbers from 0 to 4294967295"
