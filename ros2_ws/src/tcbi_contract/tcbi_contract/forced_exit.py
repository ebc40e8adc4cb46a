"""The end of a process that nothing holds up, not even a library that waits for ever with the interpreter in its hands.

A timer of the system calls `_exit` from a thread of its own (POSIX timers, timer_create(2)); Python's own timers need
the interpreter, and faulthandler's knows no other status than 1.
"""

import contextlib
import ctypes
import time
from collections.abc import Iterator

SIGEV_THREAD = 2


class _Event(ctypes.Structure):
    """struct sigevent: call `function(value)` in a new thread."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("room", ctypes.c_char * 32),  # the structure has 64 bytes
    )


class _Times(ctypes.Structure):
    """struct itimerspec: how often, and when first."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("every_s", "every_ns", "first_s", "first_ns"))


@contextlib.contextmanager
def forced_exit(seconds: float, status: int) -> Iterator[None]:
    """End this process with a status if what stands in the block has not ended after so many seconds.

    Raises:
      OSError: the system makes no timer.
    """
    c = ctypes.CDLL(None, use_errno=True)
    end = ctypes.cast(c._exit, ctypes.c_void_p).value
    event, timer = _Event(status or None, 0, SIGEV_THREAD, end), ctypes.c_void_p()
    if c.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        raise OSError(ctypes.get_errno(), "no timer for the process's end")
    try:
        times = _Times(0, 0, int(seconds), int(seconds % 1 * 1e9))
        if c.timer_settime(timer, 0, ctypes.byref(times), None):
            raise OSError(ctypes.get_errno(), "no time for the process's end")
        yield
    finally:
        c.timer_delete(timer)
