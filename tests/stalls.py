"""Tests in real time on a machine that stands still: what they then see is not judged, they run again.

A robot and its nodes have deadlines of a tenth of a second and more. A machine that other programs hold up breaks them,
and a robot that then goes limp does what it should. So a test that fails while its own process was held up for that
long fails with `StalledMachine`, and that alone makes pytest run it again (`only_rerun` in pyproject.toml).
"""

import threading
import time

STALL_S = 0.1


class StalledMachine(AssertionError):
    """A test in real time failed while the machine stood still."""


class StallWatch:
    """Measures, while it is entered, how long this process was held up at a time.

    Attributes:
      longest_s: the longest time by which a thread slept more than it had asked for.
    """

    PERIOD_S = 0.02

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
        before = time.monotonic()
        while not self._stop.wait(self.PERIOD_S):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - before - self.PERIOD_S)
            before = now
