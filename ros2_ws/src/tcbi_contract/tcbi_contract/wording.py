"""How numbers stand in sentences."""

from collections.abc import Sequence


def counted(number: int, one: str) -> str:
    """A number of things: "1 fault", "2 faults"."""
    return f"{number} {one}" if number == 1 else f"{number} {one}s"


def some(names: Sequence[str]) -> str:
    """The first three of several names, and how many there are beside them."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def with_unit(value: str, unit: str) -> str:
    """A value with its unit, which is written "1" where there is none: "0.05 rad", "0.7"."""
    return value if unit in ("", "1") else f"{value} {unit}"
