"""Values as JSON knows them, so that any reader takes what is written."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any


def plain(value: Any, decimals: int | None = None) -> Any:
    """A value as JSON knows it: numpy as numbers and lists, dataclasses as objects, NaN and infinity as null.

    Args:
      value: anything; what JSON does not know becomes its text.
      decimals: that floating-point numbers keep; None for all.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, decimals) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name), decimals) for field in dataclasses.fields(value)}
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist(), decimals)
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value if decimals is None else round(value, decimals)
    if isinstance(value, (str, int, bool)) or value is None:
        return value
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item, decimals) for item in (sorted(value) if isinstance(value, (set, frozenset)) else value)]
    return str(value)
