"""Slow readings beside a rollout's samples: supply voltage and temperature, of the whole robot or of single joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tcbi_sim.measurement import Measurement

Readings = dict[str, tuple[np.ndarray, np.ndarray]]  # as in a Measurement
MARGIN_S = 1.0  # before and after a rollout in which a reading still counts: a driver's come once a second
HOLD_S, HOLD_PERIODS = 5.0, 3.0  # a reading counts for so long, or so many of its periods, whichever is more


@dataclass(frozen=True)
class Quantity:
    """What may be read.

    Attributes:
      key: its name in `Measurement.readings` and in diagnostics; `key/<joint>` is the reading of one joint.
      least: range below which readings tell nothing: two steps of the usual sensors.
    """

    key: str
    name: str
    unit: str
    least: float
    digits: int


QUANTITIES = (Quantity("temperature_C", "temperature", "degC", 2.0, 0), Quantity("voltage_V", "voltage", "V", 0.2, 1))


def is_reading(key: str, joint_names: Sequence[str]) -> bool:
    """Whether a key names a known quantity, of the whole robot or of one of these joints."""
    quantity, slash, joint = key.partition("/")
    return any(quantity == q.key for q in QUANTITIES) and (not slash or joint in joint_names)


def on_joints(m: Measurement, quantity: Quantity, time: np.ndarray) -> np.ndarray:
    """(T, J) linear between readings, NaN far from any; a joint without one of its own has the whole robot's.

    Args:
      m: the rollout.
      quantity: what was read.
      time: (T,) s of the rollout's clock.
    """
    columns = []
    for joint in m.joint_names:
        found = m.readings.get(f"{quantity.key}/{joint}", m.readings.get(quantity.key))
        columns.append(np.full(len(time), np.nan) if found is None or not len(found[0]) else _between(*found, time))
    return np.stack(columns, axis=-1)


def _between(at: np.ndarray, values: np.ndarray, time: np.ndarray) -> np.ndarray:
    hold = max(HOLD_S, HOLD_PERIODS * float(np.median(np.diff(at)))) if len(at) > 1 else HOLD_S
    after = np.clip(np.searchsorted(at, time), 0, len(at) - 1)
    away = np.minimum(np.abs(time - at[after]), np.abs(time - at[np.maximum(after - 1, 0)]))
    return np.where(away <= hold, np.interp(time, at, values), np.nan)


def within(readings: Mapping[str, tuple[np.ndarray, np.ndarray]], begin: float, end: float) -> Readings:
    """What was read in a stretch of a rollout (s), or just beside it."""
    found = {}
    for name, (time, values) in readings.items():
        inside = (time > begin - MARGIN_S) & (time < end + MARGIN_S)
        if inside.any():
            found[name] = time[inside], values[inside]
    return found


def shifted(readings: Mapping[str, tuple[np.ndarray, np.ndarray]], by: float) -> Readings:
    """The same readings on a clock whose zero lies `by` s earlier."""
    return {name: (np.round(time + by, 9), values) for name, (time, values) in readings.items()}
