"""Statistics that are compared in time, where a simulation was given the commands that the robot was given.

Histograms do not see the order of events. Where commands are replayed every sample of a simulation has its counterpart
among the robot's, and what they differ by averages the sensors' noise over all of a rollout. Means over a tenth of a
second are compared. The divergence is the mean square of their differences over the variance of what was measured: 0
for equals, 1 for a simulation that tells as much of the robot as the robot's mean does.

It weighs particles as a normal likelihood would whose variance is what the best particles leave. Of that, what is
white counts by the number of means. The rest is what the model does otherwise than the robot: it counts by as many
means as it is independent of in time (an autoregression of first order), and is in part the same in all rollouts, so
that more of them average it less. Where rollouts contradict each other alpha falls (`calibration`), as for histograms.
U units of rollouts, M particles, K statistics.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from tcbi_infer.statistics import RolloutArrays, Statistic, samples
from tcbi_infer.tcbi.expansion import Expansion

MEAN_S = 0.1  # of which means are compared: motions are no quicker, and sketches are less noisy for it
SKETCH = 256  # values, at most, that stand for a statistic's differences in a unit
LAGS = 3  # 0, 1 and 2 means: products of differences so far apart say how much of them is white
MOST_ALIKE = 0.98  # correlation of neighbours in what is not white: beyond it slow drifts would count for nothing
# power of the number of rollouts, by which more of them do not average what the model does otherwise than the robot: 0
# if each has its own, 1 if it is the same in all
SHARED = 0.5
AT_A_TIME = 500  # particles whose motions are foreseen
TINY = np.finfo(float).tiny


class Differences(NamedTuple):
    """Of M simulations from the robot's rollouts."""

    sums: np.ndarray  # (M, U, K, LAGS) float32, over means and channels: of squares, and of products at other lags
    sketch: np.ndarray  # (M, U, K, SKETCH) float32, short for all of them: inner products are theirs, about

    def join(self, other: "Differences") -> "Differences":
        """Both sets of particles, these first."""
        return Differences(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def no_differences(count: int) -> Differences:
    """Of so many particles, where nothing is compared in time."""
    return Differences(np.zeros((count, 0, 0, LAGS), np.float32), np.zeros((count, 0, 0, SKETCH), np.float32))


class InTime(NamedTuple):
    """What the real rollouts have of such statistics."""

    sampled: np.ndarray  # (U, K) means
    variance: np.ndarray  # (K,) of them, each channel about its own mean; positive
    rollouts: int  # that are compared

    def divergences(self, found: Differences, resamples: np.ndarray | None = None) -> np.ndarray:
        """(M, K), or (M, R, K) where (R, U) resamples say how often each unit counts."""
        rows = 1 if resamples is None else len(resamples)
        if not self.variance.size:
            return np.zeros((len(found.sums), 0) if resamples is None else (len(found.sums), rows, 0))
        often = np.ones((1, len(self.sampled))) if resamples is None else resamples.astype(float)
        squares = np.einsum("ru,muk->mrk", often, found.sums[..., 0])
        divergence = squares / np.maximum((often @ self.sampled) * self.variance, TINY)
        return divergence[:, 0] if resamples is None else divergence

    def noise(self, found: Differences, particle: int) -> tuple[np.ndarray, np.ndarray]:
        """(K,) divergence of a particle that is right, and (K,) degrees of freedom that it is spread over."""
        if not self.variance.size:
            return np.zeros(0), np.zeros(0)
        count = self.sampled.sum(axis=0)
        square, next_to, second = (found.sums[particle].sum(axis=0).astype(float) / count[:, None]).T
        alike = np.clip(second / np.maximum(next_to, TINY), 0.0, MOST_ALIKE)
        coloured = np.clip(next_to / np.maximum(alike, TINY), 0.0, square)
        spread = square - coloured + coloured * self.rollouts**SHARED * (1 + alike) / (1 - alike)
        return square / self.variance, np.clip(count * square / np.maximum(spread, TINY), 1.0, count)

    def motion(self, found: Differences, floor: np.ndarray) -> np.ndarray:
        """(M, U * K * SKETCH) differences by (K,) floors: the sum of a row's squares is about its energy."""
        scale = floor * self.variance * self.sampled.sum(axis=0)
        return (found.sketch / np.sqrt(scale)[:, None]).reshape(len(found.sketch), -1)

    def foreseen(self, found: Differences, floor: np.ndarray, expansion: Expansion, z: np.ndarray) -> Differences:
        """The same with squares as an expansion of (M, P) particles' motions has them, where it foresees their motion.

        What contacts throw at random into one simulation is not in them: particles near each other weigh alike.
        """
        motion, squares = self.motion(found, floor), found.sums[..., 0].copy()
        scale = floor * self.variance * self.sampled.sum(axis=0)
        for begin in range(0, len(z), AT_A_TIME):
            part = slice(begin, begin + AT_A_TIME)
            expected = expansion.motion(z[part])
            known = expansion.foresees(expected, motion[part])
            by_unit = (expected.reshape(-1, *found.sketch.shape[1:]) ** 2).sum(axis=-1) * scale
            squares[part] = np.where(known[:, None, None], by_unit, squares[part])
        share = squares / np.maximum(found.sums[..., 0], TINY)
        return found._replace(sums=found.sums * share[..., None])

    def doubt(self, floor: np.ndarray, expansion: Expansion) -> np.ndarray:
        """(K,) divergence as large as an expansion's own error: what it misses, over particles for each parameter."""
        missed = expansion.missed.reshape(len(self.sampled), -1, SKETCH).sum(axis=(0, 2))
        return floor * missed * len(expansion.center) / expansion.particles


NOTHING = InTime(np.zeros((0, 0)), np.zeros(0), 0)


def comparable(
    statistics: Sequence[Statistic], real: Sequence[RolloutArrays], replayed: Sequence[bool], blocks: int
) -> tuple[tuple[Statistic, ...], InTime]:
    """Which of the statistics can be compared in time, and what the real rollouts have of them.

    Args:
      statistics: to compare.
      real: the groups of rollouts.
      replayed: of each group, whether simulations are given the recorded commands.
      blocks: that each rollout is cut into.
    """
    kept, counts, variances = [], [], []
    for statistic in statistics:
        values = [
            np.where(again, _means(samples(statistic, arrays), arrays), np.nan)
            for arrays, again in zip(real, replayed, strict=True)
        ]
        count = np.concatenate([_in_blocks(np.isfinite(v).astype(float), blocks) for v in values], axis=1)[0]
        square = sum(float(np.nansum((v - _mean(v)) ** 2)) for v in values)
        if square > 0:
            kept.append(statistic)
            counts.append(count)
            variances.append(square / count.sum())
    rollouts = sum(arrays.count[1] for arrays, again in zip(real, replayed, strict=True) if again)
    return tuple(kept), InTime(np.stack(counts, axis=-1), np.array(variances), rollouts) if kept else NOTHING


def differences(
    statistics: Sequence[Statistic],
    real: Sequence[RolloutArrays],
    simulated: Sequence[RolloutArrays],
    replayed: Sequence[bool],
    blocks: int,
) -> Differences:
    """What simulations, without their sensors' noise, differ from the robot by.

    Args:
      statistics: of `comparable`.
      real: the groups of rollouts.
      simulated: the same of N particles.
      replayed: of each group, whether it was given the recorded commands; where not, nothing is compared.
      blocks: that each rollout is cut into.
    """
    particles = simulated[0].count[0]
    if not statistics:
        return no_differences(particles)
    sums, sketches = [], []
    for statistic in statistics:
        rows: list[np.ndarray] = []
        sketch: list[np.ndarray] = []
        for measured, arrays, again in zip(real, simulated, replayed, strict=True):
            if not again:
                units = arrays.count[1] * blocks
                rows.append(np.zeros((particles, units, LAGS)))
                sketch.append(np.zeros((particles, units, SKETCH)))
                continue
            there = samples(statistic, measured)
            measured_at = np.isfinite(there)
            apart = np.where(measured_at, samples(statistic, arrays) - there, 0.0)
            share = _means(measured_at.astype(float), arrays)
            apart = _means(apart, arrays) / np.where(share > 0, share, 1.0)
            rows.append(np.stack([_in_blocks(_products(apart, lag), blocks) for lag in range(LAGS)], axis=-1))
            sketch.append(_sketched(apart, blocks))
        sums.append(np.concatenate(rows, axis=1))
        sketches.append(np.concatenate(sketch, axis=1))
    return Differences(np.stack(sums, axis=2).astype(np.float32), np.stack(sketches, axis=2).astype(np.float32))


def _means(values: np.ndarray, arrays: RolloutArrays) -> np.ndarray:
    """(N, S, C, T) samples -> (N, S, C, K) means over `MEAN_S`, NaN of none; what is left at the end is left out."""
    each = max(1, round(MEAN_S / float(arrays.time[1] - arrays.time[0])))
    whole = values[..., : values.shape[-1] // each * each]
    split = whole.reshape(*whole.shape[:-1], -1, each)
    known = np.isfinite(split)
    count = known.sum(axis=-1)
    return np.where(count > 0, np.where(known, split, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _products(values: np.ndarray, lag: int) -> np.ndarray:
    """(N, S, C, K) samples -> the same of each with the one so many samples before, 0 where there is none."""
    found = np.zeros_like(values)
    found[..., lag:] = values[..., lag:] * values[..., : values.shape[-1] - lag]
    return found


def _sketched(values: np.ndarray, blocks: int) -> np.ndarray:
    """(N, S, C, K) samples -> (N, S * blocks, SKETCH)."""
    n, s = values.shape[:2]
    parts = (part.reshape(n * s, -1) for part in np.array_split(values, blocks, axis=-1))
    return np.stack([(part @ _signs(part.shape[1])).reshape(n, s, SKETCH) for part in parts], axis=2).reshape(
        n, s * blocks, SKETCH
    )


@functools.lru_cache(maxsize=16)
def _signs(length: int) -> csr_array:
    """(length, SKETCH): each of so many values adds to one place of a sketch, with a random sign.

    The count sketch of Charikar, Chen and Farach-Colton 2002.
    """
    rng = np.random.default_rng(length)
    places = np.arange(length) if length <= SKETCH else rng.integers(0, SKETCH, length)
    return csr_array((rng.choice([-1.0, 1.0], length), (np.arange(length), places)), shape=(length, SKETCH))


def _mean(values: np.ndarray) -> np.ndarray:
    """(1, S, C, K) samples -> (1, 1, C, 1) mean of those that there are, 0 of none."""
    total = np.nansum(values, axis=(1, 3), keepdims=True)
    return total / np.maximum(np.isfinite(values).sum(axis=(1, 3), keepdims=True), 1)


def _in_blocks(values: np.ndarray, blocks: int) -> np.ndarray:
    """(N, S, C, K) samples -> (N, S * blocks) sums over channels and stretches of a rollout's samples."""
    parts = [part.sum(axis=(2, 3)) for part in np.array_split(values, blocks, axis=-1)]
    return np.stack(parts, axis=-1).reshape(len(values), -1)
