"""Held-out gains of several kinds of motion as one total with its standard error, one strange kind notwithstanding.

Where a foot slips in one motion and not in its prediction, that motion's score says nothing of servos. The mean is
trimmed and its standard error comes from the winsorised variance (Tukey and McLaughlin, Sankhya A 25, 1963); the limit
that a gain must pass is simulated with the same statistic.
"""

import numpy as np
from scipy.special import stdtrit

TRIMMED = 0.2  # of the kinds of motion at either end: one of five to nine
LEAST_SE = 0.3  # nats a kind, added in quadrature, so that tiny gains that agree by chance do not count


def cut(count: int) -> int:
    """How many of so many kinds are trimmed at either end."""
    return int(TRIMMED * count)


def total(gains: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sum of gains and its standard error, NaN of a single kind.

    Args:
      gains: (F, ...) nats.
      sizes: (F,) replicate sets of each kind: of one with half as many, half the gain is expected.
    """
    count = len(gains)
    share = np.asarray(sizes, float) / np.mean(sizes)
    rates = np.sort(gains / share.reshape(-1, *[1] * (gains.ndim - 1)), axis=0)
    ends = cut(count)
    kept = rates[ends : count - ends]
    if count < 2:
        return gains.sum(axis=0), np.full(gains.shape[1:], np.nan)
    spread = np.std(np.clip(rates, kept[0], kept[-1]), axis=0, ddof=1)
    return count * kept.mean(axis=0), spread * np.sqrt((share**2).sum()) * count / len(kept)


def statistic(gains: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(...) total gain over its standard error; 0 of a single kind of motion."""
    gain, se = total(gains, sizes)
    return gain / np.sqrt(np.nan_to_num(se, nan=np.inf) ** 2 + (len(gains) * LEAST_SE) ** 2)


def limit(count: int, level: float) -> float:
    """Student's quantile for one statistic of so many kinds of motion."""
    return float(stdtrit(max(count - 2 * cut(count) - 1, 1), level))
