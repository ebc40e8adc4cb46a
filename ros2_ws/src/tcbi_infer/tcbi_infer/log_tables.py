"""The columns of a log's files, JSON or CSV, as numbers: what a mapping says of them, and what is wrong with them."""

import csv
import gzip
import io
import json
import math
import reprlib
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer.errors import MappingError
from tcbi_infer.mapping import Mapping, Signal

SEPARATORS = ",;\t"  # of a CSV's columns: the one that its header has most of

Table = dict[str, list[Any]]


class Tables:
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
    except UnicodeDecodeError as e:
        raise MappingError(f"{path}: is no UTF-8 text ({e}); save it as UTF-8") from e
    except (OSError, EOFError, zlib.error) as e:
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


def stamps(tables: Tables, signal: Signal) -> np.ndarray:
    """(N,) ns."""
    values = numbers(tables, signal, signal.time or tables.mapping.time_column)
    if not np.isfinite(values).all():
        untimed = np.flatnonzero(~np.isfinite(values))
        raise MappingError(
            f"{tables.log}: {counted(len(untimed), 'sample')} without a time, the first is sample {untimed[0] + 1}; "
            "remove them"
        )
    return np.rint(values * tables.mapping.time_scale * 1e9).astype(np.int64)


def rows_of(tables: Tables, signal: Signal, width: int, what: str = "joints") -> np.ndarray:
    """(N, width) in SI units; of joints in the order of the mapping's."""
    if signal.listed:
        values = _lists(tables, signal, max(signal.pick or tuple(range(width))) + 1)
        values = values[:, list(signal.pick)] if signal.pick else values
    else:
        values = np.stack([numbers(tables, signal, name) for name in signal.columns], axis=-1)
    if values.shape[1] != width:
        raise MappingError(
            f"{tables.log}: {signal.columns[0]} gives {values.shape[1]} values, the mapping names {width} {what}; list "
            f"the {what} in the log's order, or choose values with `pick`"
        )
    return values * np.asarray(signal.scale) + np.asarray(signal.offset)


def numbers(tables: Tables, signal: Signal, name: str) -> np.ndarray:
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


def _lists(tables: Tables, signal: Signal, least: int) -> np.ndarray:
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
