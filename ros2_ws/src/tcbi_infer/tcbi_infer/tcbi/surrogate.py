"""Where the posterior is expected: a quadratic fitted to the energies of the best particles.

Used to propose only. The weights always come from simulations, so a poor fit costs particles and no honesty.
"""

import numpy as np

SHARE = 0.25  # of the particles, those of least energy, that the quadratic is fitted to
WIDEN = 2.0  # on the covariance
RIDGE = 1e-3


def expected_normal(z: np.ndarray, energy: np.ndarray, alpha: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean (P,) and covariance (P, P) of exp(-alpha energy) x standard normal prior, widened.

    Args:
      z: (M, P) particles in probit space.
      energy: (M,) theirs; inf where the simulation diverged.
      alpha: the inverse temperature aimed at.

    Returns:
      None while the particles are too few for a quadratic.
    """
    m, p = z.shape
    unknowns = 1 + p + p * (p + 1) // 2
    usable = np.flatnonzero(np.isfinite(energy))
    near = usable[np.argsort(energy[usable], kind="stable")[: max(2 * unknowns, int(SHARE * m))]]
    if len(near) < 1.5 * unknowns:
        return None
    center = z[near[0]]
    scale = np.maximum(z[near].std(axis=0), 1e-6)
    x = (z[near] - center) / scale
    first, second = np.triu_indices(p)
    design = np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], axis=1)
    rise = energy[near] - energy[near[0]]
    weight = 1.0 / (1.0 + rise / max(np.median(rise), 1e-12))  # the lower, the more it counts
    left = design.T @ (design * weight[:, None]) + RIDGE * weight.sum() * np.diag([0.0] + [1.0] * (unknowns - 1)) / len(
        x
    )
    fitted = np.linalg.solve(left + 1e-9 * np.eye(unknowns), design.T @ (weight * rise))
    slope, hessian = fitted[1 : 1 + p], np.zeros((p, p))
    hessian[first, second] += fitted[1 + p :]
    hessian[second, first] += fitted[1 + p :]
    values, vectors = np.linalg.eigh(hessian)
    convex = (vectors * np.maximum(values, 0.0)) @ vectors.T
    unit = np.diag(1.0 / scale)
    precision = np.eye(p) + alpha * unit @ convex @ unit
    covariance = np.linalg.inv(precision)
    mean = center - covariance @ (center + alpha * unit @ slope)
    low, high = z[near].min(axis=0), z[near].max(axis=0)
    return np.clip(mean, low, high), WIDEN * covariance
