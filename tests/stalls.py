"""Tests in real time on a machine that has no time for them: what they then see is not judged, they run again.

A robot and its nodes have deadlines of a tenth of a second and more. A machine that stands still, or has other programs
to run, breaks them, and a robot that then goes limp does what it should. So a test fails with `StalledMachine` while
its own process slept too long, or a thread of it or of its nodes had to wait for a processor that long, and that alone
makes pytest run it again (`only_rerun` in pyproject.toml).
"""

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

STALL_S = 0.1


class StalledMachine(AssertionError):
    """A test in real time failed while the machine held it up."""


class StallWatch:
    """Measures, while it is entered, how long this process and those that it has started were held up at a time.

    Attributes:
      longest_s: the longest time by which a thread slept more than it had asked for, or for which one that wanted to
        run waited within `WINDOW_S` (Linux's count of its run queues). Processes of lower priority may wait.
    """

    PERIOD_S, WINDOW_S = 0.02, 0.3

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall watch", daemon=True)

    @property
    def stalled(self) -> bool:
        """Whether that was long enough for a robot to miss a deadline."""
        return self.longest_s >= STALL_S

    def __enter__(self) -> "StallWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        before = looked = time.monotonic()
        waited = dict(waits())
        while not self._stop.wait(self.PERIOD_S):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - before - self.PERIOD_S)
            if now - looked > self.WINDOW_S:
                present = dict(waits())
                known = (present[thread] - waited[thread] for thread in present.keys() & waited.keys())
                self.longest_s = max([self.longest_s, *known])
                waited, looked = present, now
            before = time.monotonic()


def waits() -> Iterator[tuple[int, float]]:
    """Threads of this process and of those that it has started, and how long (s) each has waited for a processor."""
    for process in _family(os.getpid()):
        with contextlib.suppress(OSError):  # it has ended
            if os.getpriority(os.PRIO_PROCESS, process) > 0:
                continue
            for thread in Path(f"/proc/{process}/task").iterdir():
                with contextlib.suppress(OSError):
                    yield int(thread.name), 1e-9 * int((thread / "schedstat").read_text().split()[1])


def _family(process: int) -> Iterator[int]:
    """A process and all that descend from it."""
    yield process
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            with contextlib.suppress(OSError):
                for child in (thread / "children").read_text().split():
                    yield from _family(int(child))
