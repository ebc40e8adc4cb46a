"""Logs of other formats, JSON or CSV, as measurements: what a small mapping file says of their columns.

    mapping = load_mapping("xl330_bench")             # a built-in mapping, or the path of a TOML file
    measurement = read_log(mapping, Path("kp100_sin_sin.json"))

A log is a file, or a folder of files (say, commands and states apart). docs/bags.md describes the mapping file.
Repeated and backward time stamps are put in order, and said, as in any bag; so is what is left out.
"""

import csv
import gzip
import io
import json
import math
import reprlib
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer.bags.streams import ordered
from tcbi_infer.errors import MappingError
from tcbi_infer.mapping import Mapping, Signal
from tcbi_infer.pieces import pieces
from tcbi_infer.readings import Readings, within
from tcbi_sim.measurement import Commands, Measurement, Scenario

SEPARATORS = ",;\t"  # of a CSV's columns: the one that its header has most of

Table = dict[str, list[Any]]


def read_log(mapping: Mapping, log: Path) -> Measurement:
    """One log as one rollout.

    Raises:
      MappingError: the log cannot be read, or is not what the mapping says; everything wrong at once where possible.
    """
    notes: list[str] = []
    tables = _Tables(mapping, log, notes)
    position = mapping.position
    stamp = _stamps(tables, position, mapping)
    order = ordered(position.columns[0], stamp, notes)
    rows = _rows(tables, position, mapping)[order]
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        notes.append(f"{int(np.sum(~finite))} samples hold no number and are left out")
    order, rows = order[finite], rows[finite]
    if len(order) < 2:
        because = f" ({'; '.join(notes)})" if notes else ""
        raise MappingError(
            f"{log}: holds {len(order)} samples with a time and a position, at least 2 are needed{because}"
        )
    zero = int(stamp[order[0]])
    time = (stamp[order] - zero) / 1e9
    commands = _commands(tables, mapping, zero, int(stamp[order[-1]]), rows[0], notes)
    readings = within(_readings(tables, mapping, zero), 0.0, float(time[-1]))
    return Measurement(
        rollout_id=rollout_name(log),
        rig=mapping.rig,
        scenario=Scenario(
            task=mapping.task,
            duration=float(time[-1]),
            initial_joint_position=tuple(float(x) for x in rows[0]),
            settle=0.0,
            constants=_constants(mapping, tables),
        ),
        policy_id=mapping.policy_id,
        source=mapping.source,
        commands=commands,
        joint_names=mapping.joints,
        foot_names=(),
        time=time,
        joint_position=rows,
        notes=tuple(notes),
        readings=readings,
    )


def read_rollouts(mapping: Mapping, log: Path) -> list[Measurement]:
    """One log as one rollout, or as the pieces that the mapping cuts it into; raises as `read_log`."""
    whole = read_log(mapping, log)
    return pieces(whole, mapping.window) if mapping.window else [whole]


def rollout_name(log: Path) -> str:
    """A log's name without its endings."""
    name = log.name
    for suffix in (".gz", ".json", ".csv"):
        name = name.removesuffix(suffix)
    return name


class _Tables:
    """The columns of a log's files, read once; what a file loses thereby is said in `notes`."""

    def __init__(self, mapping: Mapping, log: Path, notes: list[str]) -> None:
        self.log, self.mapping, self.notes = log, mapping, notes
        self._cache: dict[Path, tuple[Table, dict[str, Any]]] = {}

    def column(self, signal: Signal, name: str) -> list[Any]:
        path = self._file(signal.file)
        table, _ = self._read(path)
        if name not in table:
            where = " (of the times: column in [time])" * (name == self.mapping.time_column)
            raise MappingError(
                f"{path}: has no column {name!r}; it has {', '.join(table) or 'none'}; correct the mapping{where}"
            )
        return table[name]

    def header(self) -> dict[str, Any]:
        """The numbers and names that a JSON log holds beside its samples."""
        path = self._file(self.mapping.position.file)
        return self._read(path)[1]

    def _file(self, name: str) -> Path:
        if not self.log.exists():
            raise MappingError(f"{self.log}: there is no such log; give a log (.json, .csv, .gz) or a folder of logs")
        if not name:
            if self.log.is_dir():
                raise MappingError(f"{self.log}: is a folder; say in the mapping which `file` in it each signal is in")
            return self.log
        if not self.log.is_dir():
            raise MappingError(
                f"{self.log}: is a file, but the mapping speaks of {name!r} in a folder; give the folder"
            )
        for candidate in (self.log / name, self.log / f"{name}.gz"):
            if candidate.is_file():
                return candidate
        raise MappingError(f"{self.log}: has no file {name!r} (nor {name}.gz), which the mapping speaks of")

    def _read(self, path: Path) -> tuple[Table, dict[str, Any]]:
        if path not in self._cache:
            self._cache[path] = _parse(path, self.mapping.entries, self.notes)
        return self._cache[path]


def _parse(path: Path, entries: str, notes: list[str]) -> tuple[Table, dict[str, Any]]:
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if path.suffix == ".gz" else raw).decode("utf-8-sig")
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as e:
        raise MappingError(f"{path}: cannot be read ({e}); record or copy it again") from e
    kind = path.name.removesuffix(".gz").rpartition(".")[2]
    if kind == "json":
        return _parse_json(path, text, entries)
    if kind == "csv":
        return _parse_csv(path, text, notes), {}
    raise MappingError(f"{path}: got a {kind!r} file, allowed are .json, .csv, and both with .gz")


def _parse_csv(path: Path, text: str, notes: list[str]) -> Table:
    head = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text), delimiter=max(SEPARATORS, key=head.count))
    try:
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as e:
        raise MappingError(f"{path}: is no CSV ({e}); record or copy it again") from e
    if not rows:
        raise MappingError(f"{path}: is empty")
    header = rows[0][1]
    if len(rows[-1][1]) < len(header):
        rows.pop()  # cut off when the logger was stopped: how most logs end, and worth no note
    odd = [line for line, row in rows if len(row) != len(header)]
    if odd:
        notes.append(
            f"{path.name}: left out {counted(len(odd), 'row')} of another width than the header's {len(header)}, "
            f"the first in line {odd[0]}"
        )
    body = [row for _, row in rows[1:] if len(row) == len(header)]
    return {name.strip(): [row[i] for row in body] for i, name in enumerate(header)}


def _parse_json(path: Path, text: str, entries: str) -> tuple[Table, dict[str, Any]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as e:
        raise MappingError(f"{path}: is no JSON ({e}); record or copy it again, or give another log") from e
    samples = content if isinstance(content, list) else content.get(entries) if isinstance(content, dict) else None
    if not isinstance(samples, list) or not samples or not all(isinstance(s, dict) for s in samples):
        raise MappingError(f"{path}: holds no list of samples under {entries!r}; set `entries` in the mapping")
    keys = list(dict.fromkeys(key for sample in samples for key in sample))  # some are told in some samples alone
    header = {k: v for k, v in content.items() if k != entries} if isinstance(content, dict) else {}
    return {key: [sample.get(key) for sample in samples] for key in keys}, header


def _stamps(tables: _Tables, signal: Signal, mapping: Mapping) -> np.ndarray:
    """(N,) ns."""
    values = _numbers(tables, signal, signal.time or mapping.time_column)
    if not np.isfinite(values).all():
        untimed = np.flatnonzero(~np.isfinite(values))
        raise MappingError(
            f"{tables.log}: {counted(len(untimed), 'sample')} without a time, the first is sample {untimed[0] + 1}; "
            "remove them"
        )
    return np.rint(values * mapping.time_scale * 1e9).astype(np.int64)


def _rows(tables: _Tables, signal: Signal, mapping: Mapping) -> np.ndarray:
    """(N, J) in rad or N m, in the order of the mapping's joints."""
    if signal.listed:
        values = _lists(tables, signal, max(signal.pick or tuple(range(len(mapping.joints)))) + 1)
        values = values[:, list(signal.pick)] if signal.pick else values
    else:
        values = np.stack([_numbers(tables, signal, name) for name in signal.columns], axis=-1)
    if values.shape[1] != len(mapping.joints):
        raise MappingError(
            f"{tables.log}: {signal.columns[0]} gives {values.shape[1]} values, the mapping names "
            f"{len(mapping.joints)} joints; list the joints in the log's order, or choose values with `pick`"
        )
    return values * np.asarray(signal.scale) + np.asarray(signal.offset)


def _numbers(tables: _Tables, signal: Signal, name: str) -> np.ndarray:
    found = []
    for row, value in enumerate(tables.column(signal, name), start=1):
        try:
            found.append(_number(value))
        except (TypeError, ValueError, OverflowError) as e:
            raise MappingError(
                f"{tables.log}: sample {row} of column {name!r} is no number: {reprlib.repr(value)}; mend or remove it"
            ) from e
    return np.array(found, float)


def _number(value: Any) -> float:
    if value is None or value == "":
        return math.nan
    if isinstance(value, str) and value.strip().lower() in ("true", "false"):
        return float(value.strip().lower() == "true")
    return float(value)


def _lists(tables: _Tables, signal: Signal, least: int) -> np.ndarray:
    """A column of lists, written as JSON in strings or as JSON itself; NaN where a list is missing or empty."""
    name = signal.columns[0]
    found = []
    for row, value in enumerate(tables.column(signal, name), start=1):
        try:
            values = json.loads(value or "null") if isinstance(value, str) else value
            if not isinstance(values, list | None):
                raise TypeError("no list")
            found.append([_number(v) for v in values or ()])
        except (TypeError, ValueError, OverflowError, RecursionError) as e:
            raise MappingError(
                f"{tables.log}: sample {row} of {name!r} is no list of numbers: {reprlib.repr(value)}"
            ) from e
    widths = sorted({len(values) for values in found if values})
    if len(widths) != 1 or widths[0] < least:
        raise MappingError(
            f"{tables.log}: {name!r} holds lists of {widths} values, at least {least} everywhere are needed"
        )
    return np.array([values or [math.nan] * widths[0] for values in found])


def _commands(tables: _Tables, mapping: Mapping, zero: int, end: int, start: np.ndarray, notes: list[str]) -> Commands:
    """The commands on the rollout's clock, from `zero` to before `end` (ns).

    One that repeats the command before it says nothing and is left out.

    Args:
      start: (J,) the first measured position, rad.
    """
    signal, none = mapping.command, Commands(np.empty(0), np.empty((0, len(mapping.joints))))
    if signal is None:
        notes.append("the mapping names no command: nothing can be simulated again with the same commands")
        return none
    stamp = _stamps(tables, signal, mapping)
    target = _rows(tables, signal, mapping)
    flag = _torque_flags(tables, mapping, len(stamp))
    there = np.isfinite(target).all(axis=1) | (flag <= 0.5)  # loggers give a limp servo no goal; its flag must stay
    if not there.all():
        notes.append(f"{signal.columns[0]}: left out {counted(int(np.sum(~there)), 'command')} without a number")
    order = np.flatnonzero(there)[ordered(signal.columns[0], stamp[there], notes)]
    stamp, on = stamp[order], flag[order] > 0.5
    if mapping.torque_commands:
        target = np.where(np.isfinite(target[order]), target[order], 0.0)  # a limp motor has none
    else:
        target = _carried(target[order], start)
    effective = stamp < end
    stamp, target, on = stamp[effective], target[effective], on[effective]
    if not stamp.size:
        notes.append("no command before the last sample: nothing can be simulated again with the same commands")
        return none
    started = np.flatnonzero(stamp <= zero)
    if started.size:  # what was in force when the first sample was taken
        stamp, target, on = stamp[started[-1] :].copy(), target[started[-1] :], on[started[-1] :]
        stamp[0] = zero
    new = np.concatenate([[True], np.any(np.diff(target, axis=0) != 0, axis=1) | (np.diff(on) != 0)])
    if mapping.ramp:
        new[:] = True  # a repeated command starts a ramp of its own
    return Commands((stamp[new] - zero) / 1e9, target[new], mapping.ramp, None if on.all() else on[new])


def _carried(target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Targets (N, J) in the order of time; what is no number becomes the joint's last one, before any `start`."""
    told = np.vstack([start, target])
    last = np.maximum.accumulate(np.where(np.isfinite(told), np.arange(len(told))[:, None], 0), axis=0)
    return np.take_along_axis(told, last, axis=0)[1:]


def _torque_flags(tables: _Tables, mapping: Mapping, count: int) -> np.ndarray:
    """(N,) above 0.5 where the servos are powered; NaN where the log does not say."""
    if mapping.torque_on is None:
        return np.ones(count)
    values = _numbers(tables, mapping.torque_on, mapping.torque_on.columns[0])
    if len(values) != count:
        raise MappingError(f"{tables.log}: {len(values)} torque flags for {count} commands; they must be in one file")
    return values


def _readings(tables: _Tables, mapping: Mapping, zero: int) -> Readings:
    """Temperatures and voltages on the rollout's clock; rows without a number are no readings."""
    found: Readings = {}
    for key, signal in mapping.readings:
        values = _numbers(tables, signal, signal.columns[0]) * np.asarray(signal.scale)
        stamp = _stamps(tables, signal, mapping)
        there = np.isfinite(values)
        order = ordered(key, stamp[there], [])
        found[key] = (stamp[there][order] - zero) / 1e9, values[there][order]
    return found


def _constants(mapping: Mapping, tables: _Tables) -> tuple[tuple[str, float], ...]:
    header = tables.header()
    found = []
    faults = []
    for name, value in mapping.constants:
        if isinstance(value, str):
            if not isinstance(header.get(value), (int, float)):
                faults.append(f"constant {name!r}: the log has no number under {value!r}")
                continue
            value = header[value]
        found.append((name, float(value)))
    if faults:
        raise MappingError(
            f"{tables.log}: {'; '.join(faults)}; it has {', '.join(header) or 'none'}; correct the mapping"
        )
    return tuple(found)


def logs_in(paths: Iterable[Path], mapping: Mapping) -> list[Path]:
    """The logs that are meant: files and folders as given; a folder of logs stands for the logs in it."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir() and not mapping.is_log(path):
            inside = [p for p in sorted(path.iterdir()) if mapping.is_log(p)]
            if not inside:
                raise MappingError(f"{path}: holds no log of this mapping")
            found += inside
        else:
            found.append(path)
    return found
