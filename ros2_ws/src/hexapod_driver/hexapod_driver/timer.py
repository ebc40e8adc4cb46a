"""When something periodic is due, on a clock that the caller reads."""


class Timer:
    """True once a period, without drift, and without catching up: what was missed is left out, and the rhythm kept."""

    def __init__(self, period_s: float, start: float) -> None:
        self.period_s = period_s
        self._next = start

    def due(self, now: float) -> bool:
        """Whether the period has passed."""
        if now < self._next:
            return False
        self._next += self.period_s * (1 + (now - self._next) // self.period_s)
        return True

    def left(self, now: float) -> float:
        """Seconds until it is due, 0 if it is."""
        return max(0.0, self._next - now)

    def soon(self, now: float, delay_s: float) -> None:
        """Be due `delay_s` from now."""
        self._next = now + delay_s

    def shift(self, by_s: float) -> None:
        """Move the rhythm, later if positive."""
        self._next += by_s
