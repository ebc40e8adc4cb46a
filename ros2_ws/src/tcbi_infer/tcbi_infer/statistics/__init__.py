"""Task statistics: rollouts -> samples. One file each; every file of this folder with a `STATISTIC` is registered, and
the user's own (docs/tcbi.md).

names = select(("reward", "attitude"), arrays)     # what these rollouts have, and what they lack
samples = library()["attitude"].compute(arrays)    # (N, S, C, K)
"""

import contextlib
import importlib
import pkgutil
from collections.abc import Iterator
from functools import cache

import numpy as np

from tcbi_infer import user_files
from tcbi_infer.errors import InferError
from tcbi_infer.statistics.base import RolloutArrays, Statistic, averaged, from_measurements, padded_commands
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.user_file import told

PAPER = ("reward", "attitude", "contact_ratio")
CALIBRATED = (*PAPER, "joint_tracking", "early_response", "body_rates", "joint_motion", "body_motion")

__all__ = [
    "CALIBRATED",
    "PAPER",
    "RolloutArrays",
    "Statistic",
    "averaged",
    "channels_of",
    "failing",
    "from_measurements",
    "library",
    "padded_commands",
    "samples",
    "select",
]


@cache
def library() -> dict[str, Statistic]:
    """Every statistic by name."""
    found: dict[str, Statistic] = {}
    for info in pkgutil.iter_modules(__path__):
        statistic = getattr(importlib.import_module(f"{__name__}.{info.name}"), "STATISTIC", None)
        if statistic is not None:
            found[statistic.name] = statistic
    return found | user_files.load_all("statistics", "STATISTIC", unusable, set(found))


def unusable(statistic: Statistic) -> str:
    """ "" or why a user's file defines no statistic; its function is checked when rollouts are there."""
    if not isinstance(statistic, Statistic):
        return f"STATISTIC is a {type(statistic).__name__}, must be a Statistic of tcbi_infer.statistics"
    calls = [name for name in ("channels", "compute", "lacks") if not callable(getattr(statistic, name))]
    return f"{calls[0]} is no function" if calls else ""


@contextlib.contextmanager
def failing(statistic: Statistic) -> Iterator[None]:
    """Around a call of a statistic, which may be the user's code.

    Raises:
      InferError: whatever it raised, with the statistic's name.
    """
    try:
        yield
    except Exception as e:
        file = getattr(getattr(statistic.compute, "__code__", None), "co_filename", statistic.name)
        raise InferError(f"statistic {statistic.name} fails: {told(e, file)}") from e


def channels_of(statistic: Statistic, arrays: RolloutArrays) -> tuple[str, ...]:
    """Names of a statistic's channels.

    Raises:
      InferError: the statistic fails.
    """
    with failing(statistic):
        return tuple(statistic.channels(arrays))


def samples(statistic: Statistic, arrays: RolloutArrays) -> np.ndarray:
    """(N, S, C, K) samples, checked.

    Raises:
      InferError: the statistic fails, or its shape is not what it promised.
    """
    with failing(statistic):
        values = np.asarray(statistic.compute(arrays), float)
    expected = (*arrays.count, len(channels_of(statistic, arrays)))
    if values.ndim != 4 or values.shape[:3] != expected:
        raise InferError(f"statistic {statistic.name} gave shape {values.shape}, must be {expected} and its samples")
    return values


def select(names: tuple[str, ...], arrays: RolloutArrays) -> tuple[tuple[Statistic, ...], tuple[str, ...]]:
    """The named statistics that these rollouts allow, and a line for each that they do not.

    Raises:
      UnknownNameError: there is no such statistic.
      InferError: nothing is left, or a statistic fails.
    """
    for name in names:
        if name not in library():
            raise UnknownNameError("statistic", name, sorted(library()))
    reasons = {name: _missing(library()[name], arrays) for name in names}
    kept = tuple(library()[name] for name in names if not reasons[name])
    left_out = tuple(f"statistic {name} left out: the rollouts have {why}" for name, why in reasons.items() if why)
    if not kept:
        others = [name for name, other in library().items() if name not in names and not _missing(other, arrays)]
        remedy = f"; --statistics may be {', '.join(others)}" if others else ""
        raise InferError(f"no statistic can be computed from these rollouts: {'; '.join(left_out)}{remedy}")
    return kept, left_out


def _missing(statistic: Statistic, arrays: RolloutArrays) -> str:
    with failing(statistic):
        return statistic.missing(arrays)
