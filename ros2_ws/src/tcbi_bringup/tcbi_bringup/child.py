"""What a new process does before it becomes the program: it must not outlive the one that started it."""

import ctypes
import os
import signal

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True)


def prepare_child(parent: int) -> None:
    """For `subprocess.Popen(preexec_fn=...)`: SIGTERM when the starting thread ends; Ctrl-C works as usual.

    Args:
      parent: process id of the starter.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's `&` leaves it ignored
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it was gone before the call above
        os._exit(1)


def foreign_environment() -> dict[str, str]:
    """The environment for a program that is not of this virtual environment, without its libraries and its guard."""
    environment = dict(os.environ)
    for name in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH", "VIRTUAL_ENV"):
        environment.pop(name, None)
    return environment
