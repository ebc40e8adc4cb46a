"""A user's own statistics and divergences: one file each in a folder, read without trusting it.

Statistics lie in the folder that TCBI_STATISTICS names, else in `statistics` of the store; divergences in that of
TCBI_DIVERGENCES, else in `divergences`. A file that cannot be used is left out with a line in the log, which a command
shows on standard error, and everything else goes on. Files whose names begin with _ or . are not read.
"""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tcbi_contract.errors import TcbiError
from tcbi_infer.errors import InferError
from tcbi_sim import user_file
from tcbi_sim.places import default_root
from tcbi_sim.user_file import python_files, read, told

log = logging.getLogger(__name__)


class UserFileError(InferError):
    """A user's file that holds nothing usable."""

    def __init__(self, path: Path, fault: str):
        self.fault = fault
        super().__init__(f"{path}: {fault}")


def folder(kind: str) -> Path:
    """Of the user's own files of a kind, "statistics" or "divergences"."""
    given = os.environ.get(f"TCBI_{kind.upper()}")
    return Path(given).expanduser() if given else default_root().expanduser() / kind


def load_all(kind: str, attribute: str, check: Callable[[Any], str], taken: set[str]) -> dict[str, Any]:
    """What the user's files of a kind define, by the file's name without its ending.

    Args:
      kind: of the folder.
      attribute: the name that a file defines.
      check: "" or what is wrong with such a value.
      taken: names that are in use already.
    """
    found: dict[str, Any] = {}
    if os.environ.get(f"TCBI_{kind.upper()}") and not folder(kind).is_dir():
        log.warning("tcbi: own %s: %s is no folder; make it, or unset TCBI_%s", kind, folder(kind), kind.upper())
    for path in python_files(folder(kind)):
        try:
            if path.stem in taken:
                raise UserFileError(path, f"the name {path.stem!r} is taken already; rename the file")
            value = load(path, attribute, check)
            if getattr(value, "name", path.stem) != path.stem:
                raise UserFileError(path, f"what it defines is called {value.name!r}; call the file {value.name}.py")
            found[path.stem] = value
        except UserFileError as e:
            log.warning("tcbi: own %s: %s is left out: %s", kind, path, e.fault)
    return found


def load(path: Path, attribute: str, check: Callable[[Any], str]) -> Any:
    """What one file defines under a name.

    Raises:
      UserFileError: it cannot be imported, or what it defines cannot be used.
    """
    try:
        value = read(path, attribute)
    except user_file.UserFileError as e:
        raise UserFileError(path, "; ".join(e.faults)) from e
    if value is None:
        raise UserFileError(path, f"defines no {attribute}; write {attribute} = …")
    try:
        fault = check(value)
    except TcbiError as e:
        fault = str(e)
    except Exception as e:  # noqa: BLE001 - it is the user's code, which may raise anything
        fault = f"fails when tried: {told(e, path)}"
    if fault:
        raise UserFileError(path, fault)
    return value
