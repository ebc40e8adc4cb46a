"""How good a probabilistic prediction is: continuous ranked probability score, and the band that should hold 90 %.

A prediction is an equal mixture of Gaussians: one for each draw of the model's parameters, all as wide as the noise.
"""

import math

import numpy as np
from scipy.special import ndtr

BAND90 = 1.645  # standard deviations either side of the mean that hold 90 % of a Gaussian


def crps(measured: np.ndarray, predicted: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Continuous ranked probability score of each sample, in the sample's unit; smaller is better.

    The closed form for a mixture of Gaussians (Grimit et al. 2006, doi:10.1256/qj.05.235), with the pairs of one draw
    with itself left out (the fair score of Ferro 2014, doi:10.1002/qj.2270): its expectation does not depend on how
    many draws were made. A single draw is scored as one Gaussian.

    Args:
      measured: (...).
      predicted: (N, ...) one for each draw of the parameters.
      sigma: standard deviation of the noise, broadcast to (...).

    Returns:
      (...), NaN where `measured` or a draw is NaN.
    """
    count = len(predicted)
    away = np.mean([_distance(measured - p, sigma) for p in predicted], axis=0)
    if count == 1:
        return away - np.asarray(sigma) / math.sqrt(math.pi)
    apart = np.zeros_like(away)
    wide = math.sqrt(2.0) * np.asarray(sigma)
    for i in range(count):
        for j in range(i):
            apart += _distance(predicted[i] - predicted[j], wide)
    return away - apart / (count * (count - 1))


def _distance(difference: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Mean absolute value of a Gaussian with this mean and standard deviation."""
    z = difference / sigma
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return 2.0 * sigma * density + difference * (2.0 * ndtr(z) - 1.0)


def predictive_band(predicted: np.ndarray, sigma: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """The central 90 % of what the model says would be measured, noise included, by mean and variance.

    Args:
      predicted: (N, ...) one for each draw of the parameters; of a single one the noise alone makes the band.
      sigma: standard deviation of the noise, broadcast to (...).

    Returns:
      low, high: (...).
    """
    middle = np.mean(predicted, axis=0)
    half = BAND90 * np.sqrt(np.var(predicted, axis=0) + np.asarray(sigma) ** 2)
    return middle - half, middle + half
