"""Where the posterior is expected: energies between the simulated particles, by Gaussian process regression.

An energy is known at the simulated particles alone, and roughly: rollouts with contacts scatter. A Gaussian process
through the square roots of the lowest ones (roots rise like a distance, about evenly) says what to expect elsewhere
(Wilkinson 2014, Accelerating ABC methods using Gaussian processes). It is used to propose only: weights come from
simulations, so a poor fit costs particles and no honesty. Of what is compared in time an `Expansion` says more.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from tcbi_infer.tcbi.expansion import Expansion
from tcbi_infer.tcbi.proposal import log_prior
from tcbi_infer.tcbi.weights import normalised, resample

SHARE = 0.5  # of the particles, those of least energy, that are regressed
FEWEST, MOST = 20, 200  # of them
ROUNDS = 4
CANDIDATES, CENTERS = 2000, 200  # in each round but the last, and drawn from them
LAST = 5000  # candidates in the last round
BANDWIDTH = 0.5  # of the candidates' kernels, times the spread of their centers
MARGIN = 1.0  # standard deviations of the particles by which draws may lie beyond them
NOISE = 0.1  # expected standard deviation of the noise, where that of the roots is 1
LOOSE, FURTHEST = 1.0, 4.0  # standard deviation of the logarithms of what is fitted about that, and their limit


class Emulator(NamedTuple):
    """Energies expected in probit space."""

    z: np.ndarray  # (n, P) particles that it rests on
    mean: float  # of the roots of their energies
    spread: float
    scales: np.ndarray  # (P,) length scales
    height: float  # of the process, times `spread`
    pull: np.ndarray  # (n,)

    def energy(self, z: np.ndarray) -> np.ndarray:
        """(N,) expected at (N, P)."""
        near = np.exp(-0.5 * cdist(z / self.scales, self.z / self.scales, "sqeuclidean"))
        root = self.mean + self.spread * self.height**2 * (near @ self.pull)
        return np.maximum(root, 0.0) ** 2


def emulator(z: np.ndarray, energy: np.ndarray) -> Emulator | None:
    """Regress the energies; None while the particles are too few.

    Args:
      z: (M, P) particles in probit space.
      energy: (M,) theirs, above the least; inf where the simulation diverged.
    """
    usable = np.flatnonzero(np.isfinite(energy))
    count = min(max(FEWEST, int(SHARE * len(usable))), MOST)
    if len(usable) < max(FEWEST, 4 * z.shape[1]):
        return None
    near = usable[np.argsort(energy[usable], kind="stable")[:count]]
    x, root = z[near], np.sqrt(energy[near])
    mean, spread = float(root.mean()), max(float(root.std()), 1e-9)
    y, apart = (root - mean) / spread, (x[:, None, :] - x[None, :, :]) ** 2
    expected = np.r_[np.log(np.maximum(x.std(axis=0), 1e-3)), 0.0, np.log(NOISE)]
    bounds = np.stack([expected - FURTHEST, expected + FURTHEST], axis=1)
    found = minimize(_loss, expected, args=(y, apart, expected), jac=True, method="L-BFGS-B", bounds=bounds).x
    scales, height = np.exp(found[:-2]), float(np.exp(found[-2]))
    return Emulator(x, mean, spread, scales, height, cho_solve(_factor(found, apart)[1], y))


def _factor(logs: np.ndarray, apart: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, bool]]:
    """Covariances (n, n) without the noise, and the factor of those with it."""
    covariance = np.exp(2 * logs[-2] - 0.5 * apart @ np.exp(-2 * logs[:-2]))
    noise = (np.exp(2 * logs[-1]) + 1e-6) * np.eye(len(covariance))
    return covariance, cho_factor(covariance + noise, lower=True)


def _loss(logs: np.ndarray, y: np.ndarray, apart: np.ndarray, expected: np.ndarray) -> tuple[float, np.ndarray]:
    """Negative log posterior of the logarithms of length scales, height and noise, and its gradient."""
    covariance, factor = _factor(logs, apart)
    pull = cho_solve(factor, y)
    inverse = cho_solve(factor, np.eye(len(y)))
    slope = 0.5 * (inverse - np.outer(pull, pull))  # with respect to the covariances
    weighted = slope * covariance
    scales = np.einsum("ij,ijp->p", weighted, apart) * np.exp(-2 * logs[:-2])
    gradient = np.r_[scales, 2 * weighted.sum(), 2 * np.exp(2 * logs[-1]) * np.trace(slope)]
    off = (logs - expected) / LOOSE
    loss = 0.5 * y @ pull + np.log(np.diag(factor[0])).sum() + 0.5 * off @ off
    return float(loss), gradient + off / LOOSE


def expected_draws(
    rng: np.random.Generator,
    z: np.ndarray,
    energy: np.ndarray,
    alpha: float,
    count: int,
    moves: Expansion | None = None,
) -> np.ndarray | None:
    """(count, P) draws of exp(-alpha energy) x standard normal prior, as the emulator expects it; None without one.

    Candidates come from kernels on the particles, then from kernels on what was drawn in the round before. Far beyond
    the particles that the emulator rests on, it is not asked.

    Args:
      rng: of the draws.
      z: (M, P) particles in probit space.
      energy: (M,) theirs, above the least; inf where the simulation diverged.
      alpha: as above.
      count: of the draws.
      moves: expects a further part of the energy, which the energies here are without.
    """
    expects = emulator(z, energy)
    if expects is None:
        return None
    margin = MARGIN * expects.z.std(axis=0)
    low, high = expects.z.min(axis=0) - margin, expects.z.max(axis=0) + margin
    centers = expects.z
    for left in reversed(range(ROUNDS)):
        sd = BANDWIDTH * np.maximum(centers.std(axis=0), 1e-3)
        tried = CANDIDATES if left else LAST
        drawn = centers[rng.integers(0, len(centers), tried)] + sd * rng.standard_normal((tried, z.shape[1]))
        energies = expects.energy(drawn) + (0.0 if moves is None else moves.energy(drawn))
        log_weights = log_prior(drawn) - alpha * energies
        log_weights -= _crowding(drawn / sd, centers / sd)
        inside = ((drawn >= low) & (drawn <= high)).all(axis=1)
        weights = normalised(np.where(inside, log_weights, -np.inf))
        centers = drawn[resample(rng, weights, CENTERS if left else count)]
    return centers


def _crowding(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(N,) log-density at (N, P) of even standard normal kernels on (n, P) centers, but for a constant.

    In single precision, of places about the centers' mean: good to a few 1e-3 at worst, and it only weighs candidates.
    """
    middle = centers.mean(axis=0)
    x, c = (np.asarray(v - middle, np.float32) for v in (points, centers))
    squares = (x**2).sum(axis=1)[:, None] + (c**2).sum(axis=1) - 2.0 * x @ c.T
    nearest = squares.min(axis=1)
    return np.log(np.exp(-0.5 * (squares - nearest[:, None])).sum(axis=1)) - 0.5 * nearest
