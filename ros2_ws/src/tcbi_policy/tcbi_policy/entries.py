"""What the entries of a policy's card may hold, and how those that hold something else are named.

faults(card, {"name": FILE_NAME, "curve": LIST}, "card")   # ["card.name: got '../x', allowed is a plain file name"]
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcbi_contract.errors import describe


@dataclass(frozen=True)
class Kind:
    """What an entry may hold: in words, and as a test."""

    words: str
    holds: Callable[[Any], bool]


def faults(data: Any, kinds: Mapping[str, Kind], where: str) -> list[str]:
    """One line for each entry of `data` that is not of its kind; entries that are not there are no faults."""
    if not isinstance(data, dict):
        return [describe(where, data, OBJECT.words)]
    wrong = (name for name, kind in kinds.items() if name in data and not kind.holds(data[name]))
    return [describe(f"{where}.{name}", data[name], kinds[name].words) for name in wrong]


def _is_number(value: Any) -> bool:
    """Neither NaN, nor infinite, nor an integer beyond every float."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value) and len(set(value)) == len(value)


def _is_file_name(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and value not in ("", "..") and Path(value).name == value


TEXT = Kind("text", lambda value: isinstance(value, str))
OBJECT = Kind("an object", lambda value: isinstance(value, dict))
LIST = Kind("a list", lambda value: isinstance(value, list))
NAMES = Kind("a list of names, each once", _are_names)
FILE_NAME = Kind("a plain file name", _is_file_name)
NUMBER = Kind("a finite number", _is_number)
NUMBER_OR_NONE = Kind("a finite number, or null", lambda value: value is None or _is_number(value))
POSITIVE = Kind("a finite number above 0", lambda value: _is_number(value) and value > 0)
