"""What inference keeps of a simulation: histograms of its statistics, rollout by rollout.

Counts of several rollouts add, so the divergence of any subset or bootstrap sample of rollouts is known without
simulating again; the trajectories themselves are dropped. M particles, U units (rollouts, or blocks of rollouts where
there are few), C channels of all histograms in a row, B bins. Of K statistics that are compared in time (`in_time`) it
is sums over each unit instead; they stand behind the histograms wherever divergences stand in a row.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tcbi_contract.wording import some
from tcbi_infer.divergence import Binning
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.in_time import NOTHING, Differences, InTime
from tcbi_infer.tcbi.pooled import JensenShannon, PooledDivergence
from tcbi_sim.workers import threads_here

IN_CACHE = 5  # particles whose resamples are judged at a time: with 16 it takes twice as long


class Features(NamedTuple):
    """Simulated rollouts of M particles."""

    counts: np.ndarray  # (M, U, C, B) float32
    divergence: np.ndarray  # (M, C + K) of all rollouts together, by the divergence that was chosen
    reward: np.ndarray  # (M,) mean reward per control step; NaN where the task has none
    valid: np.ndarray  # (M,) bool, False where the simulation diverged
    differences: Differences  # of what is compared in time

    def join(self, other: "Features") -> "Features":
        """Both sets of particles, these first."""
        counts, divergence, reward, valid = (np.concatenate(pair) for pair in zip(self[:-1], other[:-1], strict=True))
        return Features(counts, divergence, reward, valid, self.differences.join(other.differences))


class Observed(NamedTuple):
    """The real rollouts, in the same bins."""

    counts: np.ndarray  # (U, C, B) float32
    statistic: np.ndarray  # (C + K,) index into `statistics`
    statistics: tuple[str, ...]
    channels: tuple[str, ...]  # C + K names, statistic/channel
    measure: PooledDivergence = JensenShannon()  # of the histograms
    in_time: InTime = NOTHING

    @property
    def histograms(self) -> int:
        """C."""
        return len(self.statistic) - len(self.in_time.variance)

    def by_statistic(self, values: np.ndarray) -> np.ndarray:
        """(..., C + K) -> (..., statistics): the mean over each statistic's channels."""
        parts = [values[..., self.statistic == i].mean(axis=-1) for i in range(len(self.statistics))]
        return np.stack(parts, axis=-1)


def binned(values: np.ndarray, binnings: list[Binning], blocks: int) -> np.ndarray:
    """(N, S, C, K) samples -> (N, S * blocks, C, B) float32 counts; a block is a stretch of a rollout's samples."""
    n, s, c, _ = values.shape
    counts = np.empty((n, s, blocks, c, binnings[0].bins), np.float32)
    for b, part in enumerate(np.array_split(values, blocks, axis=-1)):
        for i, binning in enumerate(binnings):
            counts[:, :, b, i] = binning.counts(part[:, :, i])
    return counts.reshape(n, s * blocks, c, -1)


def weighable(features: Features, channels: Sequence[str]) -> np.ndarray:
    """(M,) bool: the simulations that did not diverge and have a finite divergence in each of C channels.

    Raises:
      InferError: there is none; the line says why.
    """
    finite = np.isfinite(features.divergence)
    usable = features.valid & finite.all(axis=1)
    if usable.any():
        return usable
    if not features.valid.any():
        raise InferError(
            f"all {len(usable)} simulations diverged: the model is unstable over its whole prior; "
            "narrow the parameters' bounds or lower the time step"
        )
    shares = np.mean(~finite[features.valid], axis=0)
    raise InferError(not_finite(channels, shares == shares.max()))


def not_finite(channels: Sequence[str], which: np.ndarray) -> str:
    """A line for those of C channels, by (C,) bool, of which no divergence is to be had."""
    names = [name for name, lacking in zip(channels, which, strict=True) if lacking]
    return (
        f"the divergence of {some(names)} is not finite, so no simulation can be weighed; if it is your own, mend "
        "it (samples may be all equal, or missing), else take another one or leave the statistic out"
    )


def divergences(observed: Observed, simulated: np.ndarray) -> np.ndarray:
    """(M, C) of the pooled counts, of (M, U, C, B)."""
    return observed.measure(observed.counts.sum(axis=0), simulated.sum(axis=1))


def resampled_divergences(observed: Observed, simulated: np.ndarray, resamples: np.ndarray) -> np.ndarray:
    """Divergence (M, R, C) of counts pooled in R ways.

    Args:
      observed: the real rollouts.
      simulated: (M, U, C, B).
      resamples: (R, U) how often each unit counts.
    """
    weights = resamples.astype(np.float32)
    real = np.tensordot(weights, observed.counts, axes=1)
    flat = simulated.reshape(*simulated.shape[:2], -1)
    parts = [flat[begin : begin + IN_CACHE] for begin in range(0, len(flat), IN_CACHE)]
    with ThreadPoolExecutor(threads_here()) as pool:
        found = pool.map(lambda part: observed.measure(real, (weights @ part).reshape(-1, *real.shape)), parts)
        return np.concatenate(list(found))
