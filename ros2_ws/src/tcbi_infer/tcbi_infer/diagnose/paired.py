"""Held-out gains of several kinds of motion as one total with its standard error, one strange kind notwithstanding.

Where a foot slips in one motion and not in its prediction, that motion's score says nothing of servos. The mean is
trimmed and its standard error comes from the winsorised variance (Tukey and McLaughlin, Sankhya A 25, 1963); the limit
that a statistic must pass is simulated with the same.
"""

import functools

import numpy as np

from tcbi_infer.compare.replicates import MIN_KINDS

TRIMMED = 0.2  # of the kinds of motion at either end: one of five to nine
LEAST_SE = 0.3  # of a root of nats a kind, added in quadrature: tiny gains that agree by chance do not count
LEVEL = 0.95
DRAWS, LARGE = 50_000, 100.0  # of simulated gains, nats


def cut(count: int) -> int:
    """How many of so many kinds are trimmed at either end."""
    return int(TRIMMED * count)


def total(gains: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sum of gains and its standard error, NaN of a single kind.

    A kind in which the candidate diverged is no strange kind to trim: the sum is then -inf, its standard error NaN.

    Args:
      gains: (F, ...) nats; -inf or NaN where the candidate diverged, inf where only the model before it did, which
        counts as the largest finite one.
      sizes: (F,) replicate sets of each kind: of one with half as many, half the gain is expected.
    """
    count = len(gains)
    share = np.asarray(sizes, float) / np.mean(sizes)
    rates = gains / share.reshape(-1, *[1] * (gains.ndim - 1))
    largest = np.max(rates, axis=0, where=np.isfinite(rates), initial=-np.inf)
    rates = np.sort(np.where(np.isposinf(rates), largest, rates), axis=0)
    ends = cut(count)
    kept = rates[ends : count - ends]
    told = (gains > -np.inf).all(axis=0) & np.isfinite(kept).all(axis=0)
    if count < 2:
        return np.where(told, gains.sum(axis=0), -np.inf), np.full(gains.shape[1:], np.nan)
    kept = np.where(told, kept, 0.0)
    spread = np.std(np.clip(rates, kept[0], kept[-1]), axis=0, ddof=1)
    se = spread * np.sqrt((share**2).sum()) * count / len(kept)
    return np.where(told, count * kept.mean(axis=0), -np.inf), np.where(told, se, np.nan)


def statistic(gains: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(...) total of the gains' signed square roots over its standard error; 0 of a single kind of motion, -inf where
    the candidate diverged.

    A gain grows with the square of what a motion shows of an effect, so motions that show it more or less differ far
    more in their gains than in the square roots of these.
    """
    share = (np.asarray(sizes, float) / np.mean(sizes)).reshape(-1, *[1] * (gains.ndim - 1))
    with np.errstate(invalid="ignore"):
        rates = gains / share
        roots = np.sign(rates) * np.sqrt(np.abs(rates))
    gain, se = total(roots * share, sizes)
    with np.errstate(invalid="ignore"):
        found = gain / np.sqrt(np.nan_to_num(se, nan=np.inf) ** 2 + (len(gains) * LEAST_SE) ** 2)
    return np.where(np.isneginf(gain), gain, found)


def level(kinds: int) -> float:
    """The share of data sets without a cause that a limit must hold off.

    K kinds of motion have 2^(K-1) patterns of sign, and in the worst of them whatever the model lacks looks like an
    effect in every kind. Of five that alone is more than 5 %, so that no data could pass a limit at 95 %: there it
    lies in the middle of the second worst. With fewer, of which no false-alarm rate is told, it is left at 95 %.
    """
    return min(LEVEL, 1 - 3 / 2**kinds) if kinds >= MIN_KINDS else LEVEL


@functools.lru_cache
def limit(kinds: int) -> float:
    """The statistic's quantile at `level` where gains are normal, independent and zero in the mean; infinite of one."""
    if kinds < 2:
        return np.inf
    gains = np.random.default_rng(0).normal(size=(kinds, DRAWS)) * LARGE
    return float(np.quantile(statistic(gains, np.ones(kinds)), level(kinds)))
