"""Scalars as TensorBoard's event files, without the library: what Stable-Baselines3 logs, and the evaluations.

    events = EventFile(folder / "tensorboard")
    events.add(4096, {"evaluation/mean_return": 512.0})
    algorithm.set_logger(Logger(None, [events]))          # it is one of Stable-Baselines3's writers

Then `tensorboard --logdir FOLDER`. Every life of a run has a file of its own, which TensorBoard joins.
"""

import os
import struct
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter

from tcbi_policy.protobuf import double, nested, number, single, text


class EventFile(KVWriter):
    """One event file; the folder is made with the first scalar."""

    def __init__(self, folder: Path):
        self._path = folder / f"events.out.tfevents.{time.time_ns() // 10**9}.{os.getpid()}"

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Append scalars of one step."""
        values = b"".join(nested(1, text(1, tag) + single(2, float(value))) for tag, value in scalars.items())
        self._append(number(2, step) + nested(5, values))

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """What Stable-Baselines3 calls after each set of steps."""
        numbers = {key: value for key, value in key_values.items() if isinstance(value, (int, float, np.number))}
        self.add(step, {key: float(value) for key, value in numbers.items()})

    def close(self) -> None:
        """Every record is written at once."""

    def _append(self, event: bytes) -> None:
        if not self._path.exists():
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(_record(double(1, time.time()) + text(3, "brain.Event:2")))
        with self._path.open("ab") as file:
            file.write(_record(double(1, time.time()) + event))


def _record(data: bytes) -> bytes:
    """A TFRecord: length, its checksum, data, its checksum."""
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc(length)) + data + struct.pack("<I", masked_crc(data))


def masked_crc(data: bytes) -> int:
    """TFRecord's checksum: CRC-32C, rotated and shifted."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _table()[(crc ^ byte) & 0xFF] ^ crc >> 8
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


@cache
def _table() -> tuple[int, ...]:
    """CRC-32C (Castagnoli) of each byte."""
    rows = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
        rows.append(byte)
    return tuple(rows)
