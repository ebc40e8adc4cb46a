"""`./tcbi test`: linter, type checker and all tests; or the tests of one path."""

import argparse
import itertools
import os
import subprocess
import sys
from pathlib import Path

from tcbi_bringup.commands import console
from tcbi_bringup.errors import BringupError

PASSES_ON = True  # everything goes to pytest as it is
SUMMARY = "Run linter, formatter check, type checker and all tests; with arguments, pytest alone with these."
CHECKS = (
    ("ruff check", ("ruff", "check", "--quiet")),
    ("ruff format", ("ruff", "format", "--check", "--quiet")),
    ("mypy", ("mypy", "--no-error-summary")),
)
PARALLEL = ("-n", "logical", "--maxprocesses", "4", "--dist", "loadfile")  # each file's tests by one process
PYTEST_USAGE = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What follows goes to pytest."""
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="passed on to pytest: a path, -k, -x, -m, …")
    console.add_examples(
        parser,
        "./tcbi test",
        "./tcbi test ros2_ws/src/tcbi_sim/test/test_urdf.py",
        "./tcbi test -m 'not graph and not slow'",
    )


def run(args: argparse.Namespace) -> int:
    """All checks, then pytest, whose summary comes last; 0 if all pass."""
    root = checkout()
    given = list(itertools.dropwhile("--".__eq__, args.arguments))
    passed = True
    if not given:
        for name, command in CHECKS:
            passed &= check(name, command, root)
    arguments = pytest_arguments(given or list(PARALLEL), root)
    pytest = subprocess.run([sys.executable, "-m", "pytest", *arguments], check=False)
    if pytest.returncode == PYTEST_USAGE:
        return 2
    return 0 if passed and pytest.returncode == 0 else 1


def check(name: str, command: tuple[str, ...], root: Path) -> bool:
    """One static check, its complaints passed through."""
    targets = source_folders(root) if command[0] == "mypy" else []
    result = subprocess.run([sys.executable, "-m", *command, *targets], cwd=root, check=False)
    console.note(f"{name}: {'ok' if result.returncode == 0 else 'FAILED'}")
    return result.returncode == 0


def source_folders(root: Path) -> list[str]:
    """What the type checker reads: the packages' own modules and the set-up, without tests."""
    return [str(p.parent) for p in sorted(root.glob("ros2_ws/src/*/*/__init__.py"))] + [str(root / "tcbi_setup")]


def pytest_arguments(given: list[str], root: Path) -> list[str]:
    """The arguments as given, with the whole checkout where they name no path."""
    if any(Path(word.partition("::")[0]).exists() for word in given if not word.startswith("-")):
        return given
    return [*given, f"--rootdir={root}", str(root / "ros2_ws" / "src"), str(root / "tests")]


def checkout() -> Path:
    """The folder that holds the sources.

    Raises:
      BringupError: this is an installation without sources.
    """
    for folder in (Path(os.environ.get("TCBI_ROOT", ".")), *Path.cwd().parents):
        if (folder / "ros2_ws" / "src").is_dir() and (folder / "pyproject.toml").is_file():
            return folder.resolve()
    raise BringupError("the tests need the project's checkout; call ./tcbi test inside it")
