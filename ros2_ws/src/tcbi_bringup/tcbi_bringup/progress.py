"""Progress of one piece of work on standard error: a bar in a terminal, elsewhere a line now and then.

    with progress("recording", total=8, unit="rollouts") as advance:
        for ... : advance(1)                       # or advance(done=12), advance(note="generation 3")

The time left is shown only while there is an estimate of it: `Estimate` says where it comes from.
"""

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

LINE_PERIOD_S = 10.0  # between two lines of progress where standard error is no terminal
QUIET_PERIOD_S = 20.0  # without one, after which one comes though nothing is new
LEAST_SHARE = 0.05  # of the work, to be done before its speed says anything


class Estimate:
    """The time left of a piece of work, from the shares of it that are told to be done, or as its owner knows it.

    The speed counts from the first share that is told, so that a start-up, or what an earlier run had done, is no part
    of it. Between two tellings the time left runs down; once it has run out there is no estimate.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._first: tuple[float, float] | None = None  # time in s, share
        self._last = 0.0
        self._end: float | None = None

    def tell(self, share: float, left_s: float | None = None) -> None:
        """A share of the work is done, 0 to 1; `left_s` is what its owner expects (NaN: unknown), else guessed."""
        now = self._clock()
        if left_s is not None:
            self._end = now + left_s if math.isfinite(left_s) else None
        elif self._first is None or share < self._last:
            self._first, self._end = (now, share), None
        elif share > self._last and share - self._first[1] >= LEAST_SHARE:
            began, before = self._first
            self._end = now + (now - began) * (1 - share) / (share - before)
        self._last = share

    def left_s(self) -> float | None:
        """Seconds left, None while unknown."""
        left = (self._end or 0.0) - self._clock()
        return left if left > 0 else None


class Work:
    """What is known of a piece of work: how much is done, for how long, and the time left."""

    def __init__(self, text: str, total: float | None = None, unit: str = "") -> None:
        self.text, self.note, self._total, self._unit = text, "", total, unit
        self._done = 0.0
        self._began = time.monotonic()
        self._estimate = Estimate()

    def advance(
        self,
        steps: float = 1,
        *,
        done: float | None = None,
        total: float | None = None,
        note: str | None = None,
        left_s: float | None = None,
    ) -> None:
        """Count on by `steps`, or to `done`."""
        self._done = done if done is not None else self._done + steps
        self._total = total if total is not None else self._total
        self.note = note if note is not None else self.note
        if self._total:
            self._estimate.tell(min(1.0, self._done / self._total), left_s)

    @property
    def share(self) -> float | None:
        """Of the work that is done, 0 to 1; None where the whole is unknown."""
        return min(1.0, self._done / self._total) if self._total else None

    def amount(self) -> str:
        """What is done: pieces where they have a name, else per cent, else a bare count."""
        if self.share is None:
            return f"{self._done:g}" if self._done else ""
        if self._unit:
            return f"{self._done:g} of {self._total:g} {self._unit}"
        return f"{math.floor(100 * self.share + 1e-9)} %"

    def elapsed_s(self) -> float:
        """Since the beginning."""
        return time.monotonic() - self._began

    def left(self) -> str:
        """The time left in words, empty while unknown."""
        left_s = self._estimate.left_s()
        return "" if left_s is None else f"{_duration(math.ceil(left_s))} left"

    def line(self) -> str:
        """All of it in one line."""
        words = (self.amount(), _duration(round(self.elapsed_s())), self.left(), self.note)
        return f"{self.text}: " + ", ".join(word for word in words if word)


def _duration(seconds: int) -> str:
    return f"{seconds} s" if seconds < 120 else f"{seconds // 60} min {seconds % 60} s"


@contextlib.contextmanager
def progress(text: str, total: float | None = None, unit: str = "") -> Iterator[Callable[..., None]]:
    """Show the progress of one piece of work.

    Args:
      text: what is being done.
      total: of what `advance` counts, None while unknown.
      unit: what is counted, as in "3 of 8 rollouts"; without it the share is shown.

    Yields: `advance(steps=1, *, done=None, total=None, note=None, left_s=None)`; `done` sets the count instead of
      adding to it, `left_s` is the time left (NaN: unknown) where the caller knows better than a guess from the speed.
    """
    work = Work(text, total, unit)
    with _bar(work) if sys.stderr.isatty() else _lines(work) as shown:
        yield shown


@contextlib.contextmanager
def _bar(work: Work) -> Iterator[Callable[..., None]]:
    import rich.console
    from rich import progress as bars

    def columns() -> dict[str, Any]:
        note = f": {work.note}" if work.note else ""
        return {"description": f"{work.text}{note}", "amount": work.amount(), "left": work.left()}

    class Left(bars.TextColumn):
        """Runs down by itself, between two calls of `advance`."""

        def render(self, task: bars.Task) -> Any:
            task.fields["left"] = work.left()
            return super().render(task)

    parts = ("{task.description}", "{task.fields[amount]}", "{task.fields[left]}")
    description, amount = (bars.TextColumn(part, markup=False) for part in parts[:2])
    bar = bars.Progress(
        description,
        bars.BarColumn(bar_width=30),
        amount,
        bars.TimeElapsedColumn(),
        Left(parts[2], markup=False),
        console=rich.console.Console(stderr=True),
        transient=True,
    )
    task = bar.add_task(total=1.0 if work.share is not None else None, **columns())

    def advance(*args: Any, **kwargs: Any) -> None:
        work.advance(*args, **kwargs)
        share = work.share
        bar.update(task, total=None if share is None else 1.0, completed=share or 0.0, **columns())

    with bar:
        yield advance


@contextlib.contextmanager
def _lines(work: Work) -> Iterator[Callable[..., None]]:
    """A line with what is new, and one now and then where nothing is."""
    shown, lock, over = 0.0, threading.Lock(), threading.Event()  # s since the beginning

    def show(period_s: float) -> None:
        nonlocal shown
        with lock:
            if work.elapsed_s() - shown >= period_s:
                shown = work.elapsed_s()
                print(work.line(), file=sys.stderr, flush=True)

    def advance(*args: Any, **kwargs: Any) -> None:
        work.advance(*args, **kwargs)
        show(LINE_PERIOD_S)

    def go_on() -> None:
        while not over.wait(QUIET_PERIOD_S):
            show(QUIET_PERIOD_S)

    threading.Thread(target=go_on, name="progress", daemon=True).start()
    try:
        yield advance
    finally:
        over.set()
    if shown:
        show(0.0)
