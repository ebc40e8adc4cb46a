"""Proposals in probit space, where the flat prior is a standard normal and no bound needs care.

A unit value u in (0, 1) becomes z = Phi^-1(u). A proposal mixes a share of the prior (so that weights stay bounded
and no mode is lost for good) with normal kernels on the weighted particles; its density is exact, which is what makes
the weights of population Monte Carlo right.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import logsumexp, ndtr, ndtri

from tcbi_infer.tcbi.weights import effective_sample_size, resample

EDGE = 1e-7  # closest a particle comes to its bounds, in shares of the range
INFLATION = 1.5  # on the kernel's standard deviation: a proposal should be wider than its target
LEAST_SD = 0.02  # of a kernel, in probit units
PAIRS = 2**22  # of particle and kernel held at a time


class Proposal(NamedTuple):
    """What one generation's particles were drawn from: the prior, kernels on particles, and one wide normal."""

    size: int  # particles drawn
    shares: np.ndarray  # (3,) of the prior, the kernels, the normal; sum to one
    centers: np.ndarray  # (n, P) of the kernels, probit space
    weights: np.ndarray  # (n,) of the kernels, sum to one
    covariance: np.ndarray  # (P, P) of each kernel
    normal_mean: np.ndarray  # (P,)
    normal_covariance: np.ndarray  # (P, P)

    @property
    def drawn(self) -> tuple[int, int, int]:
        """Particles drawn from each part."""
        first = round(self.shares[0] * self.size)
        second = min(round(self.shares[1] * self.size), self.size - first) if self.shares[2] else self.size - first
        return first, second, self.size - first - second


def to_probit(unit: np.ndarray) -> np.ndarray:
    """(0, 1) -> the real line."""
    return ndtri(np.clip(unit, EDGE, 1 - EDGE))


def from_probit(z: np.ndarray) -> np.ndarray:
    """The real line -> (0, 1)."""
    return np.clip(ndtr(z), EDGE, 1 - EDGE)


def prior_proposal(count: int, dimensions: int) -> Proposal:
    """The first generation's: the prior alone."""
    eye, nothing = np.eye(dimensions), np.zeros((0, dimensions))
    return Proposal(count, np.array([1.0, 0.0, 0.0]), nothing, np.zeros(0), eye, np.zeros(dimensions), eye)


def proposal(
    count: int, z: np.ndarray, weights: np.ndarray, normal: tuple[np.ndarray, np.ndarray] | None, prior_share: float
) -> Proposal:
    """A later generation's.

    Args:
      count: particles to draw.
      z: (M, P) particles so far.
      weights: (M,) sum to one; kernels are put on those that carry weight, with Silverman's bandwidth of their weighted
        covariance, inflated.
      normal: mean (P,) and covariance (P, P) of where the target is expected, or None for kernels alone.
      prior_share: drawn from the prior.
    """
    kept = weights > 1e-6 * weights.max()
    z, weights = z[kept], weights[kept] / weights[kept].sum()
    p = z.shape[1]
    mean = weights @ z
    spread = (z - mean).T @ ((z - mean) * weights[:, None])
    ess = max(effective_sample_size(weights), 2.0)
    factor = (4.0 / (p + 2.0)) ** (2.0 / (p + 4.0)) * ess ** (-2.0 / (p + 4.0)) * INFLATION**2
    covariance = factor * spread + LEAST_SD**2 * np.eye(p)
    rest = 1.0 - prior_share
    shares = np.array([prior_share, rest, 0.0] if normal is None else [prior_share, rest / 2, rest / 2])
    return Proposal(count, shares, z, weights, covariance, *(normal or (mean, np.eye(p))))


def draw(rng: np.random.Generator, proposal: Proposal) -> np.ndarray:
    """(count, P) particles in probit space; stratified over the prior's share and over the kernels."""
    p = len(proposal.normal_mean)
    first, second, third = proposal.drawn
    strata = np.stack([rng.permutation(first) for _ in range(p)], axis=1).reshape(first, p)
    parts = [to_probit((strata + rng.random((first, p))) / max(first, 1))]
    if second:
        centers = proposal.centers[resample(rng, proposal.weights, second)]
        parts.append(centers + rng.standard_normal(centers.shape) @ np.linalg.cholesky(proposal.covariance).T)
    if third:
        steps = rng.standard_normal((third, p)) @ np.linalg.cholesky(proposal.normal_covariance).T
        parts.append(proposal.normal_mean + steps)
    return np.concatenate(parts)


def log_prior(z: np.ndarray) -> np.ndarray:
    """(M,) log-density of the prior in probit space, without its constant."""
    return -0.5 * np.sum(z**2, axis=-1)


def log_density(proposal: Proposal, z: np.ndarray) -> np.ndarray:
    """(M,) log-density of a proposal at (M, P), without the constant that `log_prior` leaves out too."""
    first, second, third = (n / proposal.size for n in proposal.drawn)
    parts = []
    if first:
        parts.append(np.log(first) + log_prior(z))
    if second:
        parts.append(np.log(second) + log_kernels(z, proposal.centers, proposal.weights, proposal.covariance))
    if third:
        mean = proposal.normal_mean[None]
        parts.append(np.log(third) + log_kernels(z, mean, np.ones(1), proposal.normal_covariance))
    return logsumexp(np.stack(parts), axis=0)


def log_kernels(z: np.ndarray, centers: np.ndarray, weights: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(M,) log-density at (M, P) of normal kernels on (n, P) centers with (n,) weights, constant left out as above."""
    cholesky = np.linalg.cholesky(covariance)
    whitened, there = (np.linalg.solve(cholesky, points.T).T for points in (z, centers))
    rows = max(1, PAIRS // len(centers))
    parts = []
    for begin in range(0, len(z), rows):
        squares = cdist(whitened[begin : begin + rows], there, "sqeuclidean")
        nearest = squares.min(axis=1)
        parts.append(np.log(np.exp(-0.5 * (squares - nearest[:, None])) @ weights) - 0.5 * nearest)
    return np.concatenate(parts) - np.log(np.diag(cholesky)).sum()


def log_mixture(proposals: tuple[Proposal, ...], z: np.ndarray) -> np.ndarray:
    """(M,) log-density of all proposals together, each by its count (deterministic-mixture weights)."""
    total = sum(proposal.size for proposal in proposals)
    parts = [np.log(proposal.size / total) + log_density(proposal, z) for proposal in proposals]
    return logsumexp(np.stack(parts), axis=0)
