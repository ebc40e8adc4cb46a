"""Statistics that are compared in time, where a simulation was given the commands that the robot was given.

Histograms do not see the order of events. Where commands are replayed every sample of a simulation has its counterpart
among the robot's, and what they differ by averages the sensors' noise over all of a rollout. Means over a tenth of a
second are compared. The divergence is the mean square of their differences over the variance of what was measured: 0
for equals, 1 for a simulation that tells as much of the robot as the robot's mean does.

It weighs particles as a normal likelihood would whose variance is what the best particles leave. Of that, what is
white counts by the number of means. The rest is what the model does otherwise than the robot: it counts by as many
means as it is independent of in time (an autoregression of first order; channels count as independent), and is in part
the same in all rollouts, and in each cycle of a gait, so that more of them, and longer ones, average it less. Where
rollouts contradict each other alpha falls (`calibration`), as for histograms. That motions cannot be reproduced is not
told here, but by `predictive`.
U units of rollouts, M particles, K statistics.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from tcbi_infer.errors import InferError
from tcbi_infer.statistics import RolloutArrays, Statistic, samples
from tcbi_infer.tcbi.expansion import Expansion

MEAN_S = 0.1  # of which means are compared: motions are no quicker, and sketches are less noisy for it
SKETCH = 128  # values, at most, that stand for a statistic's differences in a unit
LAGS = 3  # 0, 1 and 2 means: products of differences so far apart say how much of them is white
MOST_ALIKE = 0.98  # correlation of neighbours in what is not white: beyond it slow drifts would count for nothing
# power of the number of stretches, by which more of them do not average what the model does otherwise than the robot: 0
# if each has its own, 1 if it is the same in all
SHARED = 0.5
STRETCH_S = 2.0  # of a rollout, which is at least one
AT_A_TIME = 500  # particles whose motions are foreseen
TINY = np.finfo(float).tiny


class Differences(NamedTuple):
    """Of M simulations from the robot's rollouts."""

    sums: np.ndarray  # (M, U, K, LAGS) float32, over means and channels: of squares, and of products at other lags
    sketch: np.ndarray  # (M, U, K, SKETCH) float32, short for all of them: inner products are theirs, about

    def join(self, other: "Differences") -> "Differences":
        """Both sets of particles, these first."""
        return Differences(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def only(self, particles: slice | np.ndarray) -> "Differences":
        """Of some of the particles."""
        return Differences(self.sums[particles], self.sketch[particles])


def no_differences(count: int) -> Differences:
    """Of so many particles, where nothing is compared in time."""
    return Differences(np.zeros((count, 0, 0, LAGS), np.float32), np.zeros((count, 0, 0, SKETCH), np.float32))


class InTime(NamedTuple):
    """What the real rollouts have of such statistics."""

    pairs: np.ndarray  # (U, K, LAGS) of means so far apart, those with themselves first
    variance: np.ndarray  # (K,) of them, each channel about its own mean; positive
    stretches: float  # of rollouts, that are compared

    @property
    def means(self) -> np.ndarray:
        """(U, K) how many."""
        return self.pairs[..., 0]

    def divergences(self, found: Differences, resamples: np.ndarray | None = None) -> np.ndarray:
        """(M, K), or (M, R, K) where (R, U) resamples say how often each unit counts."""
        rows = 1 if resamples is None else len(resamples)
        if not self.variance.size:
            return np.zeros((len(found.sums), 0) if resamples is None else (len(found.sums), rows, 0))
        often = np.ones((1, len(self.pairs))) if resamples is None else resamples.astype(float)
        squares = np.einsum("ru,muk->mrk", often, found.sums[..., 0])
        divergence = squares / np.maximum((often @ self.means) * self.variance, TINY)
        return divergence[:, 0] if resamples is None else divergence

    def noise(self, found: Differences, particle: int) -> tuple[np.ndarray, np.ndarray]:
        """(K,) divergence of a particle that is right, and (K,) degrees of freedom that it is spread over."""
        if not self.variance.size:
            return np.zeros(0), np.zeros(0)
        pairs = self.pairs.sum(axis=0)
        square, next_to, second = (found.sums[particle].sum(axis=0).astype(float) / np.maximum(pairs, 1)).T
        alike = np.clip(second / np.maximum(next_to, TINY), 0.0, MOST_ALIKE)
        coloured = np.clip(next_to / np.maximum(alike, TINY), 0.0, square)
        coloured, count = np.where(pairs[:, -1] > 0, coloured, square), pairs[:, 0]
        spread = square - coloured + coloured * self.stretches**SHARED * (1 + alike) / (1 - alike)
        return square / self.variance, np.clip(count * square / np.maximum(spread, TINY), 1.0, count)

    def motion(self, found: Differences, floor: np.ndarray) -> np.ndarray:
        """(M, U * K * SKETCH) differences by (K,) floors: the sum of a row's squares is about its energy."""
        by = (1 / np.sqrt(self.scale(floor))).astype(np.float32)
        return (found.sketch * by[:, None]).reshape(len(found.sketch), -1)

    def foreseen(self, found: Differences, floor: np.ndarray, expansion: Expansion, z: np.ndarray) -> Differences:
        """The same with squares as an expansion of (M, P) particles' motions has them, where it foresees their motion.

        What contacts throw at random into one simulation is not in them: particles near each other weigh alike.
        """
        sums = found.sums.copy()
        for begin in range(0, len(z), AT_A_TIME):
            part = slice(begin, begin + AT_A_TIME)
            expected, motion = expansion.motion(z[part]), self.motion(found.only(part), floor)
            known = expansion.foresees(expected, motion)
            more = (expected**2 - motion**2).reshape(-1, *found.sketch.shape[1:]).sum(axis=-1) * self.scale(floor)
            sums[part] = np.where(known[:, None, None, None], raised(sums[part], more), sums[part])
        return found._replace(sums=sums)

    def doubt(self, floor: np.ndarray, expansion: Expansion) -> np.ndarray:
        """(K,) divergence as large as an expansion's own error: what it misses, over particles for each parameter."""
        missed = expansion.missed.reshape(len(self.pairs), -1, SKETCH).sum(axis=(0, 2))
        return floor * missed * len(expansion.center) / expansion.particles

    def scale(self, floor: np.ndarray) -> np.ndarray:
        """(K,) sum of squares that is an energy of 1."""
        return floor * self.variance * self.means.sum(axis=0)


NOTHING = InTime(np.zeros((0, 0, LAGS)), np.zeros(0), 0.0)


def comparable(
    statistics: Sequence[Statistic], real: Sequence[RolloutArrays], replayed: Sequence[bool], blocks: int
) -> tuple[tuple[Statistic, ...], InTime, list[str]]:
    """Which of the statistics can be compared in time, what the real rollouts have of them, and lines on the others.

    Args:
      statistics: to compare.
      real: the groups of rollouts.
      replayed: of each group, whether simulations are given the recorded commands.
      blocks: that each rollout is cut into.

    Raises:
      InferError: a statistic has no sample at each time.
    """
    kept, counts, variances, lines = [], [], [], []
    for statistic in statistics:
        values = [
            np.where(again, means_of(statistic, arrays), np.nan) for arrays, again in zip(real, replayed, strict=True)
        ]
        known = [np.isfinite(v).astype(float) for v in values]
        count = np.concatenate([_at_lags(k, blocks) for k in known], axis=1)[0]
        square = sum(float(np.nansum((v - _mean(v)) ** 2)) for v in values)
        if square > 0:
            kept.append(statistic)
            counts.append(count)
            variances.append(square / count[:, 0].sum())
        elif any(replayed):
            lines.append(
                f"statistic {statistic.name} left out: the rollouts are too short, or it never changes in them"
            )
    compared = sum(
        arrays.count[1] * stretches(float(np.ptp(arrays.time)))
        for arrays, again in zip(real, replayed, strict=True)
        if again
    )
    found = InTime(np.stack(counts, axis=1), np.array(variances), compared) if kept else NOTHING
    return tuple(kept), found, lines


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
            there = _samples(statistic, measured)
            measured_at = np.isfinite(there)
            apart = np.where(measured_at, _samples(statistic, arrays) - there, 0.0)
            share = _means(measured_at.astype(float), arrays)
            apart = _means(apart, arrays) / np.where(share > 0, share, 1.0)
            rows.append(_at_lags(apart, blocks))
            sketch.append(_sketched(apart, blocks))
        sums.append(np.concatenate(rows, axis=1))
        sketches.append(np.concatenate(sketch, axis=1))
    return Differences(np.stack(sums, axis=2).astype(np.float32), np.stack(sketches, axis=2).astype(np.float32))


def raised(sums: np.ndarray, by: np.ndarray) -> np.ndarray:
    """(M, U, K, LAGS) sums whose squares are more by (M, U, K), and those at other lags by the same share."""
    squares = sums[..., 0]
    share = np.maximum(1 + by / np.where(squares > 0, squares, np.inf), 0.0)
    return (share[..., None] * sums).astype(np.float32)


def stretches(seconds: float) -> float:
    """That a rollout counts as, in what the model does otherwise in it."""
    return max(1.0, seconds / STRETCH_S)


def means_of(statistic: Statistic, arrays: RolloutArrays) -> np.ndarray:
    """(N, S, C, K) means of a statistic's samples over `MEAN_S`, NaN of none.

    Raises:
      InferError: the statistic has no sample at each time.
    """
    return _means(_samples(statistic, arrays), arrays)


def _samples(statistic: Statistic, arrays: RolloutArrays) -> np.ndarray:
    values = samples(statistic, arrays)
    if values.shape[-1] != len(arrays.time):
        raise InferError(
            f"statistic {statistic.name} is compared in time, so it must have a sample at each of {len(arrays.time)} "
            f"times; it gave {values.shape[-1]}"
        )
    return values


def _means(values: np.ndarray, arrays: RolloutArrays) -> np.ndarray:
    """(N, S, C, T) samples -> (N, S, C, K) means over `MEAN_S`, NaN of none; what is left at the end is left out."""
    each = max(1, round(MEAN_S / float(arrays.time[1] - arrays.time[0])))
    whole = values[..., : values.shape[-1] // each * each]
    split = whole.reshape(*whole.shape[:-1], -1, each)
    known = np.isfinite(split)
    if known.all():
        return split @ np.full(each, 1 / each)
    count = known.sum(axis=-1)
    return np.where(count > 0, np.where(known, split, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _at_lags(values: np.ndarray, blocks: int) -> np.ndarray:
    """(N, S, C, K) means -> (N, S * blocks, LAGS) sums of products of those so far apart."""
    sums = []
    for lag in range(LAGS):
        products = np.zeros_like(values)
        products[..., lag:] = values[..., lag:] * values[..., : max(values.shape[-1] - lag, 0)]
        sums.append(_in_blocks(products, blocks))
    return np.stack(sums, axis=-1)


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
