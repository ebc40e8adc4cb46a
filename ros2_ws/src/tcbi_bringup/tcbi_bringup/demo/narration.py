"""What the demo says: one line a step with its figure, on standard error, and how long each took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from tcbi_bringup.commands import console


@dataclass
class Narration:
    """The steps so far."""

    steps: list[dict[str, object]] = field(default_factory=list)  # name, seconds
    lines: list[tuple[str, str]] = field(default_factory=list)  # step, what was said
    began: float = field(default_factory=time.monotonic)
    _step: str = ""

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """One step of the story, timed."""
        self._step, begin = name, time.monotonic()
        try:
            yield
        finally:
            self.steps.append({"name": name, "seconds": round(time.monotonic() - begin, 1)})

    def say(self, text: str) -> None:
        """A line of the story."""
        elapsed = time.monotonic() - self.began
        console.note(f"[{int(elapsed // 60)}:{elapsed % 60:04.1f}] {self._step:>9}  {text}")
        self.lines.append((self._step, text))
