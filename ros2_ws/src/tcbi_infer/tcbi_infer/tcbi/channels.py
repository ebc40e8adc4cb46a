"""The channels of all statistics in a row: their names, samples and histograms, and what is odd in them."""

import numpy as np

from tcbi_infer.divergence import Binning
from tcbi_infer.statistics import RolloutArrays, Statistic, channels_of
from tcbi_infer.tcbi.features import Observed, binned

# of a channel: with fewer the histogram of a right model may lie 6 to 11 times as far off as their scatter suggests (a
# simulation of such draws), and be taken for a wrong one; with 5 at most 3 times
LEAST_SAMPLES = 5
SILENT = f"with fewer than {LEAST_SAMPLES} samples, left out; more or longer rollouts have more"
CROWDED = 0.9  # share of a channel's samples in one bin, from which it is said


def names_of(statistics: tuple[Statistic, ...], arrays: RolloutArrays) -> tuple[list[str], np.ndarray]:
    """Names statistic/channel, and each one's statistic."""
    named = [(f"{s.name}/{c}", i) for i, s in enumerate(statistics) for c in channels_of(s, arrays)]
    return [name for name, _ in named], np.array([owner for _, owner in named], int)


def pooled(parts: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Each channel's finite samples of all groups, of parts[group][statistic] (N, S, C, K)."""
    flat = [np.concatenate([v.ravel() for v in values]) for values in by_channel(parts)]
    return [values[np.isfinite(values)] for values in flat]


def by_channel(parts: list[list[np.ndarray]]) -> list[list[np.ndarray]]:
    """parts[group][statistic] (N, S, C, K) -> for each channel of all statistics, its (N, S, K) of every group."""
    out = []
    for of_groups in zip(*parts, strict=True):
        out += [[values[:, :, c] for values in of_groups] for c in range(of_groups[0].shape[2])]
    return out


def counted(
    parts: list[list[np.ndarray]], sizes: list[tuple[int, int]], used: list[int], binnings: list[Binning], blocks: int
) -> np.ndarray:
    """(N, U, C, B) float32 counts, the units of all groups in a row."""
    total = sum(s for _, s in sizes) * blocks
    counts = np.empty((sizes[0][0], total, len(used), binnings[0].bins), np.float32)
    channels = by_channel(parts)
    for c, (index, binning) in enumerate(zip(used, binnings, strict=True)):
        rows = [binned(values[:, :, None], [binning], blocks)[:, :, 0] for values in channels[index]]
        counts[:, :, c] = np.concatenate(rows, axis=1)
    return counts


def mean_reward(statistics: tuple[Statistic, ...], parts: list[list[np.ndarray]]) -> np.ndarray:
    """(N,) mean reward per control step; NaN where the reward is not among the statistics."""
    index = [i for i, s in enumerate(statistics) if s.name == "reward"]
    if not index:
        return np.full(len(parts[0][0]), np.nan)
    pooled = np.concatenate([p[index[0]].reshape(len(p[index[0]]), -1) for p in parts], axis=1)
    known = np.isfinite(pooled)
    return np.where(known, pooled, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)


def oddities(names: list[str], used: list[int], samples: list[np.ndarray], observed: Observed) -> tuple[str, ...]:
    """Lines on channels that tell little, or nothing.

    Args:
      names: of all channels.
      used: those that are looked at.
      samples: of all channels.
      observed: histograms of those that are looked at.
    """
    silent = [f"{name} ({samples[i].size} samples)" for i, name in enumerate(names) if i not in used]
    constant = [f"{names[i]} ({samples[i][0]:.3g})" for i in used if np.ptp(samples[i]) == 0]
    counts = observed.counts.sum(axis=0)
    shares = zip(used, counts.max(axis=-1) / counts.sum(axis=-1), strict=True)
    crowded = [f"{names[i]} ({share:.1%})" for i, share in shares if CROWDED < share < 1]
    found = (
        (SILENT, silent),
        (
            "the same in every sample, so it tells little (a dead sensor, or a joint that never moved)",
            constant,
        ),
        (f"nearly all samples lie in one of {counts.shape[-1]} bins, so it tells little", crowded),
    )
    return tuple(f"{what}: {', '.join(which)}" for what, which in found if which)
