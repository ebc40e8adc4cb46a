"""When a simulated clock may move: one window of control for each command that bears the present time.

The clock stands still by itself. A command stamped with the present time runs the next window, so a slow policy is
waited for and nothing is lost. Within an episode the wait is bounded: a policy that died does not stop the rollout. An
episode ends at a time known from the reset, so that the same seeds leave the same bytes, however late the caller stops
the policy.

    clock = LockstepClock(timeout_s=2.0)
    start = clock.reset(duration_ns=8_000_000_000, wall_s=time.monotonic())
    clock.begin(start, time.monotonic())
    if clock.may_run(stamp_ns):             # on a command
        clock.advance(time.monotonic())     # after the window was simulated

Times are nanoseconds of the simulated clock; `wall_s` is the steady clock. Nothing here knows ROS.
"""

from tcbi_contract.names import CONTROL_PERIOD_S

SECOND = 1_000_000_000
WINDOW = round(CONTROL_PERIOD_S * SECOND)


class LockstepClock:
    """The state of a clock that moves by commands.

    Attributes:
      now: present time, ns. Starts at 1 s, since zero means "no time yet" in ROS.
      missed: windows that were run without a command, since the last reset.
      strays: commands stamped with another time than the present, since the last reset.
    """

    def __init__(self, timeout_s: float):
        self.now = SECOND
        self.missed = 0
        self.strays = 0
        self._timeout_s = timeout_s
        self._start: int | None = None  # of the episode that was last reset
        self._end: int | None = None
        self._in_episode = False
        self._stood_since = 0.0

    @property
    def in_episode(self) -> bool:
        """Between BEGIN and END."""
        return self._in_episode

    @property
    def at_end(self) -> bool:
        """The episode ran its whole duration; the clock waits for END."""
        return self._in_episode and self._end is not None and self.now >= self._end

    def reset(self, duration_ns: int | None, wall_s: float) -> int:
        """Jump to the next whole second, where the next episode starts.

        Args:
          duration_ns: of the episode; None if it has no end of its own.
          wall_s: now.

        Returns:
          The episode's zero.
        """
        self.now = (self.now // SECOND + 1) * SECOND
        self._start, self._in_episode = self.now, False
        self._end = None if duration_ns is None else self.now + duration_ns
        self.missed = self.strays = 0
        self._stood_since = wall_s
        return self.now

    def begin(self, stamp_ns: int, wall_s: float) -> bool:
        """A rollout began; False if it is not the one that was reset last (an old latched event)."""
        if self._start is None or stamp_ns < self._start:
            return False
        self._in_episode = True
        self._stood_since = wall_s
        return True

    def end(self) -> None:
        """The rollout ended, or was given up."""
        self._in_episode, self._end = False, None

    def may_run(self, stamp_ns: int) -> bool:
        """Whether a command with this stamp runs the next window."""
        if stamp_ns != self.now:
            self.strays += 1
            return False
        return not self.at_end

    def overdue(self, wall_s: float) -> bool:
        """Whether the clock has waited long enough in an episode to go on without a command or an END."""
        return self._in_episode and wall_s - self._stood_since >= self._timeout_s

    def skip(self) -> None:
        """Go on without a command: note it, and forget an end that nobody announced."""
        if self.at_end:
            self._end = None
        else:
            self.missed += 1

    def advance(self, wall_s: float) -> int:
        """The window was simulated: the new present time."""
        self.now += WINDOW
        self._stood_since = wall_s
        return self.now
