"""What makes a test in real time run again: a machine that holds it up."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from tests.stalls import STALL_S, StallWatch, waits

BUSY = "import os; os.sched_setaffinity(0, {%d}); os.nice(%d); print(flush=True)\nwhile True: pass"


@contextlib.contextmanager
def two_on_one_processor(niceness: int) -> Iterator[list[int]]:
    """Ids of two programs that want all of one processor."""
    code = BUSY % (min(os.sched_getaffinity(0)), niceness)
    programs = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) for _ in range(2)]
    try:
        for program in programs:
            assert program.stdout is not None and program.stdout.readline()
        yield [program.pid for program in programs]
    finally:
        for program in programs:
            program.kill()
            program.communicate()


def comes(condition: Callable[[], bool], timeout_s: float = 60.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()


def test_programs_that_were_started_and_wait_for_a_processor_count() -> None:
    with two_on_one_processor(0) as ids, StallWatch() as watch:
        assert comes(lambda: watch.stalled)
        assert comes(lambda: sum(dict(waits())[i] for i in ids) >= STALL_S)


def test_programs_of_lower_priority_may_wait() -> None:
    with two_on_one_processor(5) as ids:
        assert not set(ids) & set(dict(waits()))


def test_a_sleep_that_takes_too_long_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    watch, ended = StallWatch(), []
    monkeypatch.setattr(watch._stop, "wait", lambda period: time.sleep(period + 0.15) or bool(ended))
    with watch:
        assert comes(lambda: watch.longest_s >= 0.15)
        ended.append(True)
