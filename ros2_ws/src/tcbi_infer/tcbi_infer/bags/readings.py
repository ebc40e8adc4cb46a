"""Readings out of a recording's diagnostics: the supply voltage and the temperatures that a driver tells there."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tcbi_contract.names import DIAGNOSTICS
from tcbi_infer.bags.streams import Recording, ordered
from tcbi_infer.readings import Readings, is_reading, within


def read_readings(recording: Recording, joint_names: Sequence[str], begin: int, end: int) -> Readings:
    """Readings of one rollout, by the keys of the diagnostics; empty where no node told any.

    Args:
      recording: the bag.
      joint_names: of the rig; a reading of another joint is left out.
      begin, end: of the rollout, ns.
    """
    found: dict[str, list[tuple[int, float]]] = {}
    for record in recording.records.get(DIAGNOSTICS, []):
        for key, value in _pairs(record.message):
            if is_reading(key, joint_names):
                found.setdefault(key, []).append((record.stamp, value))
    series = {key: _series(key, pairs, begin) for key, pairs in found.items()}
    return within(series, 0.0, (end - begin) * 1e-9)


def _pairs(message: Any) -> Iterator[tuple[str, float]]:
    """The keys of a `DiagnosticArray` whose values are numbers."""
    for status in message.status:
        for pair in status.values:
            try:
                value = float(pair.value)
            except ValueError:
                continue
            if math.isfinite(value):
                yield pair.key, value


def _series(key: str, pairs: list[tuple[int, float]], begin: int) -> tuple[np.ndarray, np.ndarray]:
    stamp = np.array([stamp for stamp, _ in pairs], np.int64)
    order = ordered(key, stamp, [])
    return (stamp[order] - begin) / 1e9, np.array([value for _, value in pairs])[order]
