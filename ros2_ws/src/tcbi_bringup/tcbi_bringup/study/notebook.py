"""What a study has found so far: one JSON line for each piece of work, so that a stopped study goes on.

with hold(folder):                                                      # one writer at a time; readers need none of it
    notebook = Notebook(folder / "study.jsonl")
    result = notebook.once(("train", "balance", 11, "tcbi"), work)      # work() -> dict, unless it is there already
"""

import fcntl
import functools
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from tcbi_bringup.errors import BringupError
from tcbi_bringup.study.plan import Key
from tcbi_contract.plain import plain
from tcbi_sim.ray_workers import PACKAGES, code

Result = dict[str, Any]
LOCK = ".study.lock"


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Make a study's folder, and keep every other writer out of it.

    Raises:
      BringupError: another process goes on with the study, or the folder cannot be written.
    """
    with _lock_of(folder) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise BringupError(
                f"{folder}: process {file.read().strip() or 'unknown'} goes on with this study; wait for it or stop "
                "it, look at what there is with --report, or give another --out"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


def _lock_of(folder: Path) -> TextIO:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return (folder / LOCK).open("a+")
    except OSError as error:
        raise BringupError(f"{folder}: no study can be kept there ({error.strerror}); give another --out") from error


@functools.cache
def _code() -> str:
    """A digest of the code that the results of this process come from."""
    return code((*PACKAGES, "tcbi_bringup"))


class Notebook:
    """The file, and its lines by key; of several lines with one key the last counts.

    A piece is done unless its result is marked `not_yet`: such a one can be read, and is worked out anew. Opening
    changes nothing; a last line that was cut off is cut away before the first that is written.

    Raises:
      BringupError: a line is no result.
    """

    def __init__(self, path: Path):
        self._path = path
        self._found: dict[Key, Result] = {}
        data = path.read_bytes() if path.exists() else b""
        self._complete = data.rfind(b"\n") + 1
        for number, line in enumerate(data[: self._complete].splitlines(), start=1):
            try:
                entry = json.loads(line)
                self._found[tuple(entry["key"])] = entry["result"]
            except (ValueError, KeyError, TypeError):
                raise BringupError(
                    f"{path}, line {number}: no result of a study; remove that line, and its piece is done again"
                ) from None

    def __contains__(self, key: Key) -> bool:
        return "not_yet" not in self._found.get(key, {"not_yet": True})

    def keys(self) -> list[Key]:
        """Of the pieces that were tried."""
        return list(self._found)

    def get(self, *key: Any) -> Result | None:
        """The result of a piece of work; None where it was not tried."""
        return self._found.get(key)

    def once(self, key: Key, work: Callable[[], Result]) -> Result:
        """The result under a key, worked out and kept if it is not there."""
        if key not in self:
            began, cpu = time.monotonic(), time.process_time()
            result = plain(work())
            result |= {"wall_s": round(time.monotonic() - began, 2), "cpu_s": round(time.process_time() - cpu, 2)}
            result["code"] = _code()
            self._write(json.dumps({"key": list(key), "result": result}) + "\n")
            self._found[key] = result
        return self._found[key]

    def _write(self, line: str) -> None:
        with self._path.open("ab") as file:
            file.truncate(self._complete)
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())
            self._complete = file.tell()
