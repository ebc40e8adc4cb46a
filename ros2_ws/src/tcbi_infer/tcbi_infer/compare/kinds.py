"""What an error looks like: lag, offset, droop, gain, hysteresis, or scatter."""

import dataclasses

import numpy as np

TELLS = 0.4  # share of the squared error from which a kind names it
TOGETHER = 0.6  # of what single joints show that joints with one common size must keep, to be told as one
AGAINST = -1.5  # as a gain's error: -1 is a joint that stands still, -2 one that is mirrored
SLOW = 3.0  # deg/s below which a direction counts for nothing
UNDER_LOAD = "under high load"  # the condition that goes without saying beside a droop
LAG, OFFSET, DROOP, GAIN, HYSTERESIS, SCATTER = "lag", "offset", "droop", "gain", "hysteresis", "scatter"


@dataclasses.dataclass(frozen=True)
class Kind:
    """The kind of an error, and its size: s of a lag, deg of offset, hysteresis and scatter, a share of droop and gain.

    Attributes:
      together: whether all joints err the same way.
      share: of the squared error that it makes up.
    """

    name: str
    size: float
    together: bool
    share: float

    def words(self, plural: bool, phase: str = "") -> str:
        """The verb of a sentence about one joint or several, and when that is."""
        when = phase and f" {phase}"
        if self.name == DROOP and phase == UNDER_LOAD:
            return self._verb(plural).replace(" under load", "", 1) + when
        return self._verb(plural) + when

    def _verb(self, plural: bool) -> str:
        s = "" if plural else "s"
        size, apart = abs(self.size), "" if self.together else ", each its own way"
        if self.name == LAG:
            return f"{'lag' if self.size > 0 else 'lead'}{s} the prediction by {1000 * size:.0f} ms{apart}"
        if self.name == OFFSET:
            side = "more or less" if apart else "more" if self.size > 0 else "less"
            return f"read{s} {size:.1f} deg {side} than predicted{apart}"
        if self.name == DROOP:
            if apart:
                return f"give{s} way under load {100 * size:.0f} % more or less than predicted{apart}"
            return f"give{s} way under load {100 * size:.0f} % {'more' if self.size > 0 else 'less'} than predicted"
        if self.name == GAIN and self.together and self.size < AGAINST:
            return f"move{s} against the prediction"
        if self.name == GAIN:
            move = "too far or too little" if apart else "too far" if self.size > 0 else "too little"
            return f"move{s} {100 * size:.0f} % {move}{apart}"
        if self.name == HYSTERESIS:
            verb = f"trail{s}" if self.size > 0 else f"run{s} ahead"
            return f"{verb} by {size:.1f} deg whichever way {'they move' if plural else 'it moves'}{apart}"
        return f"scatter{s} by {size:.1f} deg about the prediction"


def kind_of(error: np.ndarray, predicted: np.ndarray, velocity: np.ndarray, asked: np.ndarray | None) -> Kind:
    """The kind that makes up most of an error.

    Args:
      error: (J, n) deg, measured less predicted, NaN where it does not count; one row for each joint.
      predicted: (J, n) deg.
      velocity: (J, n) deg/s, of the prediction.
      asked: (J, n) deg, the command; None where none asks for a position, and so nothing gives way.
    """
    here = np.isfinite(error)
    error = np.where(here, error, 0.0)
    count = np.maximum(here.sum(axis=1, keepdims=True), 1)
    middle = np.where(here, predicted, 0.0).sum(axis=1, keepdims=True) / count
    shapes = {
        LAG: -velocity,
        HYSTERESIS: -np.sign(velocity) * (np.abs(velocity) > SLOW),
        OFFSET: np.ones_like(error),
        **({} if asked is None else {DROOP: predicted - asked}),
        GAIN: predicted - middle,
    }
    total = float(np.sum(error**2))
    best = Kind(SCATTER, float(np.sqrt(total / max(int(here.sum()), 1))), True, 0.0)
    for name, shape in shapes.items():
        x = np.where(here, shape, 0.0)
        own, size = np.sum(error * x, axis=1), np.sum(x**2, axis=1)
        told = size > 1e-9
        if not told.any() or total <= 0:
            continue
        each = float(np.sum(own[told] ** 2 / size[told]) / total)
        pooled = float(np.sum(own) ** 2 / np.sum(size) / total)
        if each < TELLS or each < best.share + 0.02:
            continue
        together = pooled >= TOGETHER * each
        coefficient = np.sum(own) / np.sum(size) if together else np.median(np.abs(own[told] / size[told]))
        best = Kind(name, float(coefficient), together, each)
    return best
