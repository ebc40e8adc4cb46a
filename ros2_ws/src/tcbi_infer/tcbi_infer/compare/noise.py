"""The noise floor: how much the robot differs from itself."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.replicates import Replicates
from tcbi_infer.compare.signals import Layout


@dataclasses.dataclass(frozen=True)
class NoiseFloor:
    """Standard deviation of each channel about what the robot does on average when asked the same.

    Attributes:
      values: (C,) in the channels' units, never below the channel's resolution.
      from_replicates: else estimated from fast changes of the residual, which misses slow differences.
      estimated: indices of channels without repeats of their own, though others have some.
    """

    values: np.ndarray
    from_replicates: bool
    estimated: tuple[int, ...] = ()

    def replicated(self, channel: int) -> bool:
        """Whether a channel's floor comes from repeats."""
        return self.from_replicates and channel not in self.estimated

    @property
    def statement(self) -> str:
        """Where the floor comes from, in a sentence."""
        if self.from_replicates:
            return "The noise floor is what the robot differed from itself when it repeated the same commands."
        return (
            "No two recordings of the same commands differ, so the noise floor is estimated from fast changes of the "
            "residual; slow differences between runs are missed, and the ratios may look too large. Recording each "
            "motion twice helps."
        )


def noise_floor(
    layout: Layout, measured: np.ndarray, residual: np.ndarray, replicates: Sequence[Replicates]
) -> NoiseFloor:
    """The floor from replicates where there are any, else from the residual.

    Args:
      layout: the channels.
      measured: (R, T, C) measured channels, NaN where missing.
      residual: (R, T, C) measured less predicted.
      replicates: which of the R rollouts repeat each other.
    """
    squares, freedom = np.zeros(measured.shape[-1]), np.zeros(measured.shape[-1])
    kept = layout.kept(measured.shape[1])
    for group in replicates:
        values = distinct(measured[list(group.members)])
        if len(values) < 2:
            continue
        spread = np.where(kept, values - values.mean(axis=0), np.nan)
        full = np.isfinite(spread).all(axis=0)
        squares += np.nansum(np.where(full, spread, 0.0) ** 2, axis=(0, 1))
        freedom += (len(values) - 1) * full.sum(axis=0)
    if np.any(freedom > 0):
        with np.errstate(invalid="ignore", divide="ignore"):
            values = np.sqrt(squares / freedom)
        fallback = from_fast_changes(residual)
        known = np.isfinite(values)
        estimated = tuple(int(i) for i in np.nonzero(~known)[0])
        return NoiseFloor(np.fmax(np.where(known, values, fallback), layout.floor()), True, estimated)
    return NoiseFloor(np.fmax(from_fast_changes(residual), layout.floor()), False)


def distinct(values: np.ndarray) -> np.ndarray:
    """Of (R, ...) recordings those that are no copy, to the last bit, of one before: a simulation repeats itself."""
    kept: list[int] = []
    for r in range(len(values)):
        if not any(np.array_equal(values[r], values[k], equal_nan=True) for k in kept):
            kept.append(r)
    return values[kept]


def from_fast_changes(residual: np.ndarray) -> np.ndarray:
    """(C,) standard deviation of white noise with the same second differences: r[t-1] - 2 r[t] + r[t+1]."""
    second = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
    count = np.maximum(np.isfinite(second).sum(axis=(0, 1)), 1)
    return np.sqrt(np.nansum(second**2, axis=(0, 1)) / count / 6.0)


def autocorrelation_time(values: np.ndarray) -> float:
    """Samples that one independent sample stands for: 1 + 2 sum of autocorrelations, up to their first negative.

    Args:
      values: (R, T, C) residuals; NaN counts as zero.
    """
    valid = np.isfinite(values)
    count = np.maximum(valid.sum(axis=1, keepdims=True), 1)
    x = np.where(valid, values - np.where(valid, values, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
    length = x.shape[1]
    spectrum = np.abs(np.fft.rfft(x, n=2 * length, axis=1)) ** 2
    correlation = np.fft.irfft(spectrum, axis=1)[:, :length].sum(axis=(0, 2))
    if correlation[0] <= 0:
        return 1.0
    rho = correlation / correlation[0]
    negative = np.nonzero(rho < 0)[0]
    stop = int(negative[0]) if len(negative) else length
    return float(max(1.0, 1.0 + 2.0 * rho[1:stop].sum()))
