"""What a study has found so far: one JSON line for each finished piece, so that a stopped study goes on.

notebook = Notebook(folder / "study.jsonl")
result = notebook.once(("train", "balance", 11, "tcbi"), work)      # work() -> dict, unless it is there already
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tcbi_bringup.commands.console import plain
from tcbi_bringup.study.plan import Key

Result = dict[str, Any]


class Notebook:
    """The file, and its lines by key. A last line that was cut off is written again."""

    def __init__(self, path: Path):
        self._path = path
        self._found: dict[Key, Result] = {}
        if path.exists():
            data = path.read_bytes()
            complete = data[: data.rfind(b"\n") + 1]
            if len(complete) < len(data):
                os.truncate(path, len(complete))
            for line in complete.decode().splitlines():
                entry = json.loads(line)
                self._found[tuple(entry["key"])] = entry["result"]

    def __contains__(self, key: Key) -> bool:
        return key in self._found

    def get(self, *key: Any) -> Result | None:
        """The result of a piece of work; None where it is not done."""
        return self._found.get(key)

    def once(self, key: Key, work: Callable[[], Result]) -> Result:
        """The result under a key, worked out and kept if it is not there."""
        if key not in self._found:
            began, cpu = time.monotonic(), time.process_time()
            result = plain(work())
            result |= {"wall_s": round(time.monotonic() - began, 2), "cpu_s": round(time.process_time() - cpu, 2)}
            self._found[key] = result
            if "not_yet" in result:  # until something is installed: the next call tries again
                return result
            with self._path.open("a") as file:
                file.write(json.dumps({"key": list(key), "result": result}) + "\n")
                file.flush()
                os.fsync(file.fileno())
        return self._found[key]
