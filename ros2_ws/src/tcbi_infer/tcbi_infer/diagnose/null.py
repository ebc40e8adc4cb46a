"""The threshold: what the search finds, at most, in data sets in which nothing is missing.

A null data set is made of the recording's own noise (differences between replicates, with random signs and shifts in
time), of scatter between joints, and of the discrepancy that the best candidate leaves, with a random sign for each
kind of motion: as large and as smooth as the real one, but without a cause that all motions share. The whole one-step
search is run on each.
"""

import dataclasses
import itertools

import numpy as np

from tcbi_infer.compare.noise import mean_of
from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.fit import Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.screen import Screen, Targets

DRAWS = 300  # data sets at least


@dataclasses.dataclass(frozen=True)
class Null:
    """What searching finds where nothing is missing.

    Attributes:
      threshold: for the largest statistic over all candidates, see `threshold_of`.
      maxima: (D,) the largest statistic of each null data set.
      kinds: of motion.
      targets: of the null data sets; `scale` (D,) by which each was multiplied.
    """

    threshold: float
    maxima: np.ndarray
    kinds: int
    targets: Targets
    scale: np.ndarray

    @staticmethod
    def of_no_search() -> "Null":
        """Where there was nothing to search."""
        return Null(np.inf, np.zeros(0), 0, Targets(np.zeros(0), np.zeros(0)), np.zeros(0))


def threshold_of(maxima: np.ndarray, kinds: int) -> float:
    """The point of the largest statistics of null data sets at the level of so many kinds, and at least that of one
    candidate alone whose gains have no cause."""
    return max(float(np.quantile(maxima, paired.level(kinds))), paired.limit(kinds))


def sign_patterns(kinds: int, least: int, rng: np.random.Generator) -> np.ndarray:
    """(D, kinds) random signs, `least` of them or more: each pattern as often as any other where there are no more of
    them than that, so that no threshold hangs on how often one was drawn."""
    if 2**kinds > least:
        return rng.choice([-1.0, 1.0], size=(least, kinds))
    every = np.array(list(itertools.product((-1.0, 1.0), repeat=kinds)))
    return every[np.concatenate([rng.permutation(len(every)) for _ in range(-(-least // len(every)))])]


def noise_draws(problem: Problem, sets: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """(D, S, T, C) noise of the sets' means, resampled from differences between replicates where there are any."""
    replay = problem.replay
    recordings = [replay.repeated(s) for s in sets]
    differences = [_difference(values) for values in recordings if len(values) > 1]
    pool = np.array([d for d in differences if np.isfinite(d).any()])
    shape = (draws, len(sets), *problem.observed.shape[1:])
    counted = (problem.weight[sets] > 0) / np.sqrt(np.maximum(replay.counts()[sets], 1))
    white = rng.normal(size=shape) * problem.floor
    if not len(pool):
        return white * counted
    picked = rng.integers(len(pool), size=shape[:2])
    shifts = rng.integers(shape[2], size=shape[:2])
    signs = rng.choice([-1.0, 1.0], size=shape[:2])
    for d in range(draws):
        for s in range(len(sets)):
            drawn = signs[d, s] * np.roll(pool[picked[d, s]], shifts[d, s], axis=0)
            white[d, s] = np.where(np.isfinite(drawn), drawn, white[d, s])
    return white * counted


def _difference(recordings: np.ndarray) -> np.ndarray:
    """(T, C) the first of (R, T, C) repeats against their mean, with the variance of one recording; NaN where fewer
    than two of them measured."""
    count = np.isfinite(recordings).sum(axis=0)
    apart = recordings[0] - mean_of(recordings)
    return np.where(count > 1, apart * np.sqrt(count / np.maximum(count - 1, 1)), np.nan)


def simulate_null(
    problem: Problem,
    screen: Screen,
    nuisance: Nuisance,
    leftover: np.ndarray,
    sets: np.ndarray,
    rng: np.random.Generator,
    least: int = DRAWS,
) -> Null:
    """Runs the one-step search on data sets with nothing missing.

    Args:
      problem: the data.
      screen: the search.
      nuisance: scatter between joints.
      leftover: (open sets, T, C) residual of the best candidate.
      sets: the open sets.
      rng: of the draws.
      least: number of null data sets, a few more where patterns of signs ask for it.
    """
    numbers, kinds = np.unique(problem.kind[sets], return_inverse=True)
    patterns = sign_patterns(len(numbers), least, rng)
    draws = len(patterns)
    maxima: list[float] = []
    parts: list[Targets] = []
    scales: list[np.ndarray] = []
    for block in np.array_split(np.arange(draws), max(1, draws // 50)):
        count = len(block)
        data = noise_draws(problem, sets, count, rng)
        scatter = rng.normal(size=(count, nuisance.effect.shape[-1]))
        data += np.einsum("stcq,dq->dstc", nuisance.effect[sets], scatter, optimize=True)
        data += patterns[block][:, kinds, None, None] * leftover
        scales.append(screen.unit_scale(data))
        parts.append(screen.targets(data * scales[-1][:, None, None, None]))
        maxima.extend(paired.statistic(screen.held_out(parts[-1]), screen.sizes).max(axis=0))
    values = np.array(maxima)
    kinds_count = len(screen.folds)
    targets = Targets(*(np.concatenate([getattr(p, name) for p in parts], axis=-1) for name in ("nr", "kr")))
    return Null(threshold_of(values, kinds_count), values, kinds_count, targets, np.concatenate(scales))
