"""A slow move to a posture, watched until the joints rest: part of the driver's reset. Pure."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from tcbi_contract.names import CONTROL_PERIOD_S, JOINTS

REST_S = 0.6  # joints must rest for this long, by default
SETTLE_LIMIT_S = 5.0
REST_RAD = 0.01


class PostureGoal(NamedTuple):
    """A posture, and when it counts as reached.

    Attributes:
      target: (18,) rad.
      tolerance: rad that a joint may be off at the end; a leg under load sags, a blocked one is further off.
      rest_s: s that the joints must rest.
    """

    target: tuple[float, ...]
    tolerance: float
    rest_s: float = REST_S


@dataclass
class PostureMove:
    """One slow move.

    Args:
      goal: where to.
      start: (18,) rad, where the ramps begin.
      speed: rad/s of the ramps.
      begun: steady clock, s.
      done: told success and a line at the end.
    """

    goal: PostureGoal
    start: tuple[float, ...]
    speed: float
    begun: float
    done: Callable[[bool, str], None]
    _next: float = field(init=False)
    _arrival: float = field(init=False)
    _resting: tuple[float, ...] = ()
    _resting_since: float = math.inf

    def __post_init__(self) -> None:
        self._next = self.begun
        distance = max(abs(t - s) for t, s in zip(self.goal.target, self.start, strict=True))
        ramps = math.ceil(distance / (self.speed * CONTROL_PERIOD_S))
        self._arrival = self.begun + (ramps + 1) * CONTROL_PERIOD_S

    def due(self, now: float) -> bool:
        """Whether the next ramp has to be sent, five times a second."""
        if now < self._next:
            return False
        self._next = max(self._next + CONTROL_PERIOD_S, now + CONTROL_PERIOD_S / 2)
        return True

    def outcome(self, now: float, position: Sequence[float]) -> tuple[bool, str] | None:
        """None while it moves; then success and a line."""
        if now < self._arrival:
            return None
        if not self._resting or _farthest(position, self._resting)[1] > REST_RAD:
            self._resting, self._resting_since = tuple(position), now
        name, error = _farthest(position, self.goal.target)
        if now - self._resting_since >= self.goal.rest_s:
            if error <= self.goal.tolerance:
                return True, f"at rest, {name} is farthest from the posture, by {error:.3f} rad"
            allowed = f"allowed is {self.goal.tolerance}; free the leg, then reset"
            return False, f"{name} rests {error:.3f} rad from the posture, {allowed}"
        if now - self._arrival > SETTLE_LIMIT_S:
            return False, f"the joints did not come to rest within {SETTLE_LIMIT_S} s; {name} is {error:.3f} rad off"
        return None


def _farthest(a: Sequence[float], b: Sequence[float]) -> tuple[str, float]:
    errors = [abs(x - y) for x, y in zip(a, b, strict=True)]
    worst = max(range(len(errors)), key=errors.__getitem__)
    return JOINTS[worst], errors[worst]
