"""Where the set-up keeps things, and how it writes them down."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
PRIVATE = ROOT / ".tcbi"
STATE = PRIVATE / "state"
BOOT = PRIVATE / "boot"
PIP_VENV = PRIVATE / "pip"
FETCHED_PYTHON = PRIVATE / "python"
LOG = PRIVATE / "log" / "setup.log"
SOURCE = ROOT / "ros2_ws" / "src"
WORKSPACE = PRIVATE / "ws"  # apart from ros2_ws/{build,install}, which belong to a plain `colcon build`
LOCK = ROOT / "requirements.lock"
CUDA_LOCK = ROOT / "requirements-cuda.lock"


class SetupError(Exception):
    """The set-up cannot go on; the text says what is wrong and what to do."""


def write(path: Path, text: str) -> None:
    """Write a file under a temporary name and rename it, so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
    os.chmod(name, 0o644)
    os.replace(name, path)


def read(path: Path) -> str:
    """The text of a file, empty if it is not there."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


def remove(path: Path) -> None:
    """Remove a folder; its name is free at once even if the removal is interrupted."""
    if path.exists():
        PRIVATE.mkdir(exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=PRIVATE, prefix="trash-"))
        os.rename(path, aside / path.name)
    for trash in PRIVATE.glob("trash-*"):
        shutil.rmtree(trash, ignore_errors=True)


def digest(files: Iterable[Path], *words: str) -> str:
    """Hash of words, and of names and contents of files."""
    total = hashlib.sha256()
    for word in words:
        total.update(f"{word}\n".encode())
    for file in sorted(files):
        total.update(f"{file.relative_to(ROOT)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return total.hexdigest()
