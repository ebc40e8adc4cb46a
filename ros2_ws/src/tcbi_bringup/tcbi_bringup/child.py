"""A program's first steps as a child of the launcher: it must not outlive the one that started it.

Run as a script by the launcher, `child.py PARENT COMMAND…`, which becomes COMMAND. A step of its own rather than a
function between fork and exec, because the launcher has threads. Standard library only, since it starts without site
packages.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1


def tied_to(parent: int, command: Sequence[str]) -> list[str]:
    """`command` as a command line whose process gets SIGTERM when the thread of `parent` that starts it ends."""
    return [sys.executable, "-I", "-S", os.path.abspath(__file__), str(parent), *command]


def main(parent: int, command: Sequence[str]) -> None:
    """Become `command`, tied to the parent; Ctrl-C works as usual, even below a shell's `&`."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it was gone before the call above
        sys.exit(1)
    os.execv(command[0], list(command))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
