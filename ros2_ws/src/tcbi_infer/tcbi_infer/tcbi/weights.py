"""Weighted particles: normalising, effective sample size, moments, quantiles."""

import numpy as np

SPARE = 1e-6  # of an effective sample size beyond what is asked for, so that rounded weights still have it
TEMPERATURES = 61  # at which `temper` looks, over six decades below the value wanted


def normalised(log_weights: np.ndarray) -> np.ndarray:
    """(M,) log-weights -> weights that sum to one; all zero weights become zero, not NaN."""
    most = log_weights.max() if len(log_weights) else -np.inf
    if not np.isfinite(most):
        return np.zeros(len(log_weights))
    weights = np.exp(log_weights - most)
    return weights / weights.sum()


def effective_sample_size(weights: np.ndarray) -> float:
    """Of (M,) normalised weights: 1 / sum w^2 (Algorithm 1, line 11), rounded so that M equal ones are M."""
    square = float(np.sum(weights**2))
    return round(1.0 / square, 9) if square > 0 else 0.0


def mean_and_variance(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, P) values, (M,) normalised weights -> (P,), (P,)."""
    mean = weights @ values
    return mean, weights @ (values - mean) ** 2


def quantiles(values: np.ndarray, weights: np.ndarray, levels: np.ndarray | list[float]) -> np.ndarray:
    """Weighted quantiles (len(levels), P) of (M, P) values.

    The k-th of n equal weights stands for k / (n + 1) (Weibull), so that the quantiles of few draws are not too near
    their middle; of unequal ones n is the effective sample size.
    """
    out = np.empty((len(levels), values.shape[1]))
    ess = effective_sample_size(weights)
    for p in range(values.shape[1]):
        order = np.argsort(values[:, p], kind="stable")
        cumulative = (ess * (np.cumsum(weights[order]) - 0.5 * weights[order]) + 0.5) / (ess + 1.0)
        out[:, p] = np.interp(levels, cumulative, values[order, p])
    return out


def resample(rng: np.random.Generator, weights: np.ndarray, size: int) -> np.ndarray:
    """(size,) indices, drawn systematically: each particle is drawn its expected number of times, rounded."""
    positions = (rng.random() + np.arange(size)) / size
    return np.minimum(np.searchsorted(np.cumsum(weights) / weights.sum(), positions), len(weights) - 1)


def temper(energy: np.ndarray, log_base: np.ndarray, alpha: float, least_ess: float) -> float:
    """The largest inverse temperature up to `alpha` that leaves an effective sample size of `least_ess`.

    With unequal base weights the sample size may rise before it falls, so it is looked at from the largest value down.

    Args:
      energy: (M,) what the log-weights fall by per unit of alpha; inf weighs nothing.
      log_base: (M,) log-weights at alpha = 0.
      alpha: the value wanted.
      least_ess: not more than what alpha = 0 has, else 0 is returned.
    """

    def ess(a: float) -> float:
        with np.errstate(invalid="ignore"):
            return effective_sample_size(normalised(np.where(np.isfinite(energy), log_base - a * energy, -np.inf)))

    grid = [*(alpha * np.geomspace(1.0, 1e-6, TEMPERATURES)).tolist(), 0.0]
    enough = next((k for k, a in enumerate(grid) if ess(a) >= least_ess), len(grid) - 1)
    if enough == 0:
        return alpha
    low, high = grid[enough], grid[enough - 1]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ess(middle) >= least_ess + SPARE else (low, middle)
    return low
