"""A folder that one recorder owns: a second one is refused, and what a killed one left behind is repaired.

    with RecordingFolder(path) as folder:
        for line in folder.repaired: ...      # leftovers of a recorder that was killed

The lock is the kernel's (flock), so that it vanishes with its process, however that ends.
"""

import fcntl
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import IO

from tcbi_contract.wording import counted
from tcbi_infer.bags.files import ASIDE, LOCK, finish_repairs
from tcbi_infer.bags.recovery import recover
from tcbi_infer.bags.writer import UNFINISHED
from tcbi_infer.errors import BagError, RecordingError

MEGABYTE = 1_000_000


class RecordingFolder:
    """Exclusive use of a folder for recordings.

    Raises:
      RecordingError: the folder cannot be made or written, or another recorder uses it.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path).expanduser()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock: IO[str] = (self.path / LOCK).open("a+")
        except OSError as e:
            raise RecordingError(
                f"{self.path}: cannot be used for recordings ({e.strerror}); choose another folder"
            ) from e
        self._own()
        self.repaired = self._repair()

    def _own(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            self._lock.seek(0)
            owner = self._lock.read().strip() or "unknown"
            self._lock.close()
            raise RecordingError(
                f"{self.path}: another recorder (process {owner}) records into this folder; "
                "stop it, or choose another folder"
            ) from e
        try:
            self._lock.truncate(0)
            self._lock.write(f"{os.getpid()}\n")
            self._lock.flush()
        except OSError:
            pass  # a full disk; the lock holds without the process's number

    def _repair(self) -> list[str]:
        """Give the recordings of a killed recorder an index and their final name; a line for each."""
        lines = [f"the repair of {bag.name} was interrupted; it is whole now" for bag in finish_repairs(self.path)]
        for left in sorted(self.path.glob(f"*{UNFINISHED}")):
            try:
                recovery = recover(left, owned=True)
            except RecordingError as e:
                lines.append(f"{left.name} was left unfinished and cannot be repaired now: {e}")
                continue
            except BagError as e:
                aside = left.with_suffix(ASIDE)
                if not aside.exists():
                    left.rename(aside)
                lines.append(f"{left.name} was left unfinished and cannot be repaired, it is kept as {aside.name}: {e}")
                continue
            saved = f"{counted(recovery.messages, 'message')} over {recovery.seconds:.1f} s"
            lines.append(f"{left.name} was left unfinished; saved {saved} in {recovery.bag.name}")
        return lines

    def require_space(self, megabytes: float) -> None:
        """Raise RecordingError if less than this is free, before a rollout is wasted."""
        try:
            free = shutil.disk_usage(self.path).free / MEGABYTE
        except OSError as e:
            raise RecordingError(
                f"{self.path}: cannot be used for recordings any more ({e.strerror}); start the recorder again"
            ) from e
        if free < megabytes:
            raise RecordingError(
                f"{self.path}: {free:.0f} MB are free, at least {megabytes:.0f} MB are needed for a rollout; "
                "make room on the disk"
            )

    def close(self) -> None:
        """Let others record here."""
        self._lock.close()

    def __enter__(self) -> "RecordingFolder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
