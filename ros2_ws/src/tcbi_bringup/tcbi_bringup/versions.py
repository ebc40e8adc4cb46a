"""Which version of tcbi this is, and what it stands on."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

BENEATH = ("rclpy", "mujoco", "numpy", "torch")


def versions() -> dict[str, str | None]:
    """Version by name; `commit` is the checkout's, with a `+` if files differ from it; None for what is not there."""
    found: dict[str, str | None] = {"tcbi": _installed("tcbi_bringup"), "commit": _commit()}
    found["python"] = platform.python_version()
    return found | {name: _installed(name) for name in BENEATH}


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    root = os.environ.get("TCBI_ROOT", "")
    if not root or not (Path(root) / ".git").exists():
        return None
    command = ["git", "-C", root, "describe", "--always", "--exclude=*", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() or None
