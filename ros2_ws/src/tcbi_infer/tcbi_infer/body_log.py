"""The signals of a robot's body in a log: attitude, rates, acceleration, contacts, place; sampled as its joints are."""

from typing import Any

import numpy as np

from tcbi_infer.bags.streams import ordered
from tcbi_infer.errors import MappingError
from tcbi_infer.log_tables import Tables, rows_of, stamps
from tcbi_infer.mapping import BODY, Mapping, Signal
from tcbi_sim.measurement import continuous, quaternion_from_rpy, roll_pitch_yaw
from tcbi_sim.sensing import multiply

FIELDS = {"roll_pitch_yaw": "attitude", "tracker": "position"}  # of a Measurement, where it is not the signal's name
LEAST_NORM = 0.5  # of a quaternion, which has a length of 1


def body_signals(tables: Tables, mapping: Mapping, zero: int, time: np.ndarray, notes: list[str]) -> dict[str, Any]:
    """By field of a Measurement, what the mapping has of the body, between its samples on straight lines.

    The world is turned so that the robot heads along x where the rollout begins.

    Args:
      tables: of the log.
      mapping: of it.
      zero: ns, where the rollout begins.
      time: (T,) s since then, of the joints' samples.
      notes: gets what is left out.

    Raises:
      MappingError: a signal is not what the mapping says.
    """
    found: dict[str, Any] = {}
    for key, signal in mapping.body:
        at, values = _finite(tables, signal, BODY[key][0], zero, notes)
        if key == "attitude":
            values = _quaternions(tables, signal, values)
        elif key == "roll_pitch_yaw":
            values = quaternion_from_rpy(*values.T)
        if FIELDS.get(key, key) == "attitude":
            values = continuous(values)
        values = np.stack([np.interp(time, at, column) for column in values.T], axis=-1)
        if FIELDS.get(key, key) == "attitude":
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        found[FIELDS.get(key, key)] = values
    if "attitude" in found:
        _face_forward(found)
    if mapping.contact is not None:
        at, values = _finite(tables, mapping.contact, len(mapping.feet), zero, notes)
        last = np.clip(np.searchsorted(at, time + 1e-9, side="right") - 1, 0, None)
        found["contact"] = values[last] > 0.5
    return found


def _face_forward(found: dict[str, Any]) -> None:
    """Turn attitudes and places about the vertical, so that the first attitude has no yaw."""
    yaw = roll_pitch_yaw(found["attitude"][0])[2]
    found["attitude"] = multiply(quaternion_from_rpy(*np.array([0.0, 0.0, -yaw])), found["attitude"])
    if "position" in found:
        x, y, z = found["position"].T
        found["position"] = np.stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z], axis=-1)


def _finite(tables: Tables, signal: Signal, width: int, zero: int, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """(N,) s and (N, width) of the samples that are numbers, in the order of time."""
    stamp, values = stamps(tables, signal), rows_of(tables, signal, width, "values")
    there = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not len(there):
        raise MappingError(f"{tables.log}: {signal.columns[0]} holds no number; correct the mapping, or leave it out")
    order = there[ordered(signal.columns[0], stamp[there], notes)]
    return (stamp[order] - zero) / 1e9, values[order]


def _quaternions(tables: Tables, signal: Signal, values: np.ndarray) -> np.ndarray:
    """(N, 4) of length 1."""
    length = np.linalg.norm(values, axis=1, keepdims=True)
    if (length < LEAST_NORM).any():
        raise MappingError(
            f"{tables.log}: {signal.columns[0]} has {int((length < LEAST_NORM).sum())} orientations that are no "
            "quaternions (their length is 1); leave out attitude, or mend the log"
        )
    return values / length
