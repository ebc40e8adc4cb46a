"""Weighted normal equations, set by set, and a step of them that stays inside the ranges."""

import numpy as np

WEAK = 1e-3  # inverse variance of a parameter in unit space before any data: what these do not tell stays where it is


def gram(design: np.ndarray, target: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations set by set.

    Args:
      design: (S, T, C, K).
      target: (S, T, C).
      precision: (S, T, C).

    Returns:
      (S, K, K) and (S, K).
    """
    count, width = len(design), design.shape[-1]
    flat = design.reshape(count, -1, width)
    weighted = flat * precision.reshape(count, -1, 1)
    normal = np.matmul(weighted.transpose(0, 2, 1), flat)
    slope = np.einsum("snk,sn->sk", weighted, target.reshape(count, -1))
    return normal, slope


def prior_precision(parameters: int, nuisances: int) -> np.ndarray:
    """(parameters + nuisances,) inverse variances before any data: hardly any of parameters, 1 of nuisances."""
    return np.r_[np.full(parameters, WEAK), np.ones(nuisances)]


def bounded_step(normal: np.ndarray, slope: np.ndarray, unit: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """The Gauss-Newton step of parameters in [0, 1] and of nuisances with unit prior.

    Args:
      normal: (K, K) without the prior.
      slope: (K,) without the prior.
      unit: (P,) present parameters.
      delta: (K - P,) present nuisances.

    Returns:
      (K,) step; a parameter that would leave its range stops at its bound while the others are solved again.
    """
    count = len(unit)
    matrix = normal + np.diag(prior_precision(count, len(delta)))
    right = slope - np.r_[np.zeros(count), delta]
    step = np.zeros(len(slope))
    fixed = np.zeros(len(slope), bool)
    for _ in range(count + 1):
        free = ~fixed
        step[free] = np.linalg.solve(
            matrix[np.ix_(free, free)], right[free] - matrix[np.ix_(free, fixed)] @ step[fixed]
        )
        wanted = unit + step[:count]
        outside = ((wanted < -1e-9) | (wanted > 1 + 1e-9)) & free[:count]
        if not outside.any():
            break
        step[:count][outside] = np.clip(wanted[outside], 0.0, 1.0) - unit[outside]
        fixed[:count] |= outside
    return step
