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
      repeated: motions whose repeats show it.
      motions: of these rollouts, repeated or not.
    """

    values: np.ndarray
    from_replicates: bool
    estimated: tuple[int, ...] = ()
    repeated: int = 0
    motions: int = 0

    def replicated(self, channel: int) -> bool:
        """Whether a channel's floor comes from repeats."""
        return self.from_replicates and channel not in self.estimated

    @property
    def statement(self) -> str:
        """Where the floor comes from, in a sentence."""
        if self.from_replicates:
            text = "The noise floor is what the robot differed from itself when it repeated the same commands."
            if self.repeated < self.motions:
                were, their = ("was", "its") if self.repeated == 1 else ("were", "their")
                text += f" {self.repeated} of {self.motions} motions {were} repeated; {their} scatter stands for all."
            return text
        return (
            "No two recordings repeat the same commands from the same start and differ: the noise floor is estimated "
            "from fast changes of the residual; slow differences between runs are missed, and the ratios may look too "
            "large. Recording each motion twice helps."
        )


def noise_floor(
    layout: Layout,
    measured: np.ndarray,
    residual: np.ndarray,
    replicates: Sequence[Replicates],
    readings: np.ndarray | None = None,
) -> NoiseFloor:
    """The floor from replicates where there are any, else from the residual.

    Args:
      layout: the channels.
      measured: (R, T, C) measured channels, NaN where missing.
      residual: (R, T, C) measured less predicted.
      replicates: which of the R rollouts repeat each other.
      readings: (R, T) bool, samples at which a rollout has readings of its own; all of them by default.
    """
    squares, freedom = np.zeros(measured.shape[-1]), np.zeros(measured.shape[-1])
    kept, repeated = layout.kept(measured.shape[1]), 0
    for group in replicates:
        recordings = measured[list(group.members)]
        square, free = scatter(np.where(kept, recordings[originals(recordings)], np.nan))
        squares += square.sum(axis=0)
        freedom += free.sum(axis=0)
        repeated += bool(free.any())
    fallback = np.empty(len(layout.channels))
    for kind in {c.group for c in layout.channels}:
        index = layout.where(kind)
        fallback[index] = from_fast_changes(residual[..., index], readings, layout.samples_in(kind))
    known = freedom > 0
    if not known.any():
        return NoiseFloor(np.fmax(fallback, layout.floor()), False)
    values = np.where(known, np.sqrt(squares / np.maximum(freedom, 1)), fallback)
    estimated = tuple(int(i) for i in np.nonzero(~known)[0])
    return NoiseFloor(np.fmax(values, layout.floor()), True, estimated, repeated, len(replicates))


def mean_of(repeats: np.ndarray) -> np.ndarray:
    """(...) mean of (R, ...) repeats, of those that measured; NaN where none did."""
    there = np.isfinite(repeats)
    count = there.sum(axis=0)
    return np.where(count, np.where(there, repeats, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def scatter(repeats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of squares (...) of (R, ...) repeats about their mean, and its degrees of freedom, of those that measured."""
    there = np.isfinite(repeats)
    apart = np.where(there, repeats - mean_of(repeats), 0.0)
    return (apart**2).sum(axis=0), np.maximum(there.sum(axis=0) - 1, 0)


def originals(values: np.ndarray) -> list[int]:
    """Which of (R, ...) recordings are no copy, to the last bit, of one before: a simulation repeats itself.

    What only one of the two measured does not count.
    """
    kept: list[int] = []
    for r in range(len(values)):
        if not any(_is_copy(values[r], values[k]) for k in kept):
            kept.append(r)
    return kept


def _is_copy(one: np.ndarray, other: np.ndarray) -> bool:
    both = np.isfinite(one) & np.isfinite(other)
    return bool(both.any() and np.array_equal(one[both], other[both]))


def from_fast_changes(residual: np.ndarray, readings: np.ndarray | None = None, window: int = 1) -> np.ndarray:
    """(C,) standard deviation of white noise with the same second differences: r[t-1] - 2 r[t] + r[t+1].

    Neighbours share no noise: of averages one is taken of each window, of a slow recording the samples near its own
    readings, since those interpolated between them are smoother than the sensor.

    Args:
      residual: (R, T, C), NaN where missing.
      readings: (R, T) bool, samples that lie at readings; all of them by default.
      window: samples that one value averages over.
    """
    squares, count = np.zeros(residual.shape[-1]), np.zeros(residual.shape[-1])
    for r, values in enumerate(residual):
        at = np.arange(len(values)) if readings is None else np.flatnonzero(readings[r])
        if len(at) < 3:
            continue
        stride = int(np.ceil(window * (len(at) - 1) / (at[-1] - at[0]) - 1e-9))
        at = at[stride // 2 :: stride]
        before, after = (step[:, None].astype(float) for step in (np.diff(at)[:-1], np.diff(at)[1:]))
        second = after * values[at[:-2]] - (before + after) * values[at[1:-1]] + before * values[at[2:]]
        second /= np.sqrt(before**2 + after**2 + (before + after) ** 2)
        squares += np.nansum(second**2, axis=0)
        count += np.isfinite(second).sum(axis=0)
    return np.sqrt(squares / np.maximum(count, 1))


def autocorrelation_time(values: np.ndarray) -> float:
    """Samples that one independent sample stands for: 1 + 2 sum of autocorrelations, up to their first negative.

    Lags at which no two samples were measured, as between the readings of a slow recording, have no say.

    Args:
      values: (R, T, C) residuals; NaN where nothing was measured.
    """
    valid = np.isfinite(values)
    count = np.maximum(valid.sum(axis=1, keepdims=True), 1)
    x = np.where(valid, values - np.where(valid, values, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
    length = x.shape[1]
    spectrum = np.abs(np.fft.rfft(x, n=2 * length, axis=1)) ** 2
    correlation = np.fft.irfft(spectrum, axis=1)[:, :length].sum(axis=(0, 2))
    if correlation[0] <= 0:
        return 1.0
    seen = np.abs(np.fft.rfft(valid.astype(float), n=2 * length, axis=1)) ** 2
    pairs = np.fft.irfft(seen, axis=1)[:, :length].sum(axis=(0, 2))
    rho = (correlation / correlation[0])[pairs > 0.5]
    negative = np.nonzero(rho < 0)[0]
    stop = int(negative[0]) if len(negative) else len(rho)
    return float(max(1.0, 1.0 + 2.0 * rho[1:stop].sum()))
