"""Files that a reader sees with their old content or their new one, never in part."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


def replace_file(path: Path, content: bytes | str) -> None:
    """Write a file anew, or leave it as it was.

    Raises:
      OSError: it cannot be written.
    """
    with replacement(path) as work:
        work.write_bytes(content if isinstance(content, bytes) else content.encode())


def remove_unfinished(folder: Path) -> None:
    """Remove what writers that were killed left in a folder; none may be at work there."""
    for work in folder.glob(f".*.{'[0-9a-f]' * 32}*"):
        work.unlink(missing_ok=True)


@contextlib.contextmanager
def replacement(path: Path) -> Iterator[Path]:
    """A hidden place beside a file; what is written there takes the file's place at the end, or goes with an error.

    It ends as the file does (`.npz`, for one), and no two writers share it.

    Raises:
      OSError: nothing can be written there.
    """
    work = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        yield work
        with work.open("rb") as file:
            os.fsync(file.fileno())
        work.replace(path)
    finally:
        work.unlink(missing_ok=True)
