"""Numbers in sentences."""

from tcbi_contract.wording import counted, some, with_unit


def test_one_thing_is_singular():
    assert [counted(n, "fault") for n in (0, 1, 2)] == ["0 faults", "1 fault", "2 faults"]


def test_of_many_names_three_are_said():
    assert [some("abcde"[:n]) for n in (1, 3, 5)] == ["a", "a, b, c", "a, b, c and 2 more"]


def test_a_quantity_without_a_unit_is_a_bare_number():
    assert [with_unit("0.7", unit) for unit in ("1", "", "rad", "1/s")] == ["0.7", "0.7", "0.7 rad", "0.7 1/s"]
