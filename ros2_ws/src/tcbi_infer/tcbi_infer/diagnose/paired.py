"""Held-out gains of several kinds of motion as one total with its standard error, one strange kind notwithstanding.

Where a foot slips in one motion and not in its prediction, that motion's score says nothing of servos. The mean is
trimmed and its standard error comes from the winsorised variance (Tukey and McLaughlin, Sankhya A 25, 1963).

An effect that shows in every kind of motion shows in some of them ten times as much: the spread of such gains is no
doubt that there is a gain. So whether there is one is asked of their signed roots, as likelihood ratios are compared
with a normal distribution (Barndorff-Nielsen, Biometrika 73, 1986); of few kinds none can be spared there. The limit
that it must pass is simulated with the same statistic. How large a gain is, and which of two is larger, is asked of
the gains themselves.
"""

import numpy as np
from scipy.special import stdtrit

TRIMMED = 0.2  # of the kinds of motion at either end: one of five to nine
FEW = 6  # kinds of motion: of so many all must agree that there is a gain
LEAST_SE = 0.3  # nats a kind, added in quadrature, so that tiny gains that agree by chance do not count


def cut(count: int) -> int:
    """How many of so many kinds are trimmed at either end."""
    return int(TRIMMED * count)


def total(gains: np.ndarray, sizes: np.ndarray, ends: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The sum of gains and its standard error, NaN of a single kind.

    Args:
      gains: (F, ...) nats.
      sizes: (F,) replicate sets of each kind: of one with half as many, half the gain is expected.
      ends: how many kinds are trimmed at either end; `cut` of their number by default.
    """
    count = len(gains)
    ends = cut(count) if ends is None else ends
    share = np.asarray(sizes, float) / np.mean(sizes)
    rates = np.sort(gains / share.reshape(-1, *[1] * (gains.ndim - 1)), axis=0)
    kept = rates[ends : count - ends]
    if count < 2:
        return gains.sum(axis=0), np.full(gains.shape[1:], np.nan)
    spread = np.std(np.clip(rates, kept[0], kept[-1]), axis=0, ddof=1)
    return count * kept.mean(axis=0), spread * np.sqrt((share**2).sum()) * count / len(kept)


def spared(count: int) -> int:
    """How many of so many kinds are trimmed at either end where it is asked whether there is a gain."""
    return 0 if count <= FEW else cut(count)


def certainty(gains: np.ndarray, sizes: np.ndarray, least_se: float = LEAST_SE) -> np.ndarray:
    """(...) total of what has kinds of motion first, over its standard error; 0 of a single kind."""
    gain, se = total(gains, sizes, spared(len(gains)))
    return gain / np.sqrt(np.nan_to_num(se, nan=np.inf) ** 2 + (len(gains) * least_se) ** 2)


def statistic(gains: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(...) total of the signed roots of gains (F, ...) in nats over its standard error; 0 of a single kind."""
    share = (np.asarray(sizes, float) / np.mean(sizes)).reshape(-1, *[1] * (gains.ndim - 1))
    roots = np.sign(gains) * np.sqrt(2 * np.abs(gains) / share)
    return certainty(roots * share, sizes, np.sqrt(2 * LEAST_SE))


def limit(count: int, level: float) -> float:
    """Student's quantile for one statistic of so many kinds of motion; trimmed roots ask for one freedom less."""
    ends = spared(count)
    return float(stdtrit(max(count - 2 * ends - (2 if ends else 1), 1), level))


def limit_of_total(count: int, level: float) -> float:
    """Student's quantile for one total of so many kinds of motion over its standard error."""
    return float(stdtrit(max(count - 2 * cut(count) - 1, 1), level))
