"""Proposals in probit space, where the flat prior is a standard normal and no bound needs care.

A unit value u in (0, 1) becomes z = Phi^-1(u). A proposal mixes a share of the prior (so that weights stay bounded
and no mode is lost for good) with normal kernels on the weighted particles, and on points where the posterior is
expected; its density is exact, which is what makes the weights of population Monte Carlo right.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import logsumexp, ndtr, ndtri

from tcbi_infer.tcbi.weights import effective_sample_size, resample

EDGE = 1e-7  # closest a particle comes to its bounds, in shares of the range
INFLATION = 1.5  # on the kernel's standard deviation: a proposal should be wider than its target
NEIGHBOURS = 10.0  # of an expected point, that its kernel spans, about, at most
LEAST_SD = 0.005  # of a kernel, in probit units
PAIRS = 2**22  # of particle and kernel held at a time


class Kernels(NamedTuple):
    """A normal distribution about each of some weighted points."""

    centers: np.ndarray  # (n, P) probit space
    weights: np.ndarray  # (n,) sum to one
    covariance: np.ndarray  # (P, P) of each


class Proposal(NamedTuple):
    """What one generation's particles were drawn from: the prior, kernels on particles, and on expected points."""

    size: int  # particles drawn
    shares: np.ndarray  # (3,) of the prior and of both kernels; sum to one
    found: Kernels
    expected: Kernels

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
    nothing = Kernels(np.zeros((0, dimensions)), np.zeros(0), np.eye(dimensions))
    return Proposal(count, np.array([1.0, 0.0, 0.0]), nothing, nothing)


def proposal(
    count: int, z: np.ndarray, weights: np.ndarray, expected: np.ndarray | None, prior_share: float
) -> Proposal:
    """A later generation's.

    Args:
      count: particles to draw.
      z: (M, P) particles so far.
      weights: (M,) sum to one; kernels are put on those that carry weight, inflated.
      expected: (n, P) points where the target is expected, or None for kernels on the particles alone.
      prior_share: drawn from the prior.
    """
    kept = weights > 1e-6 * weights.max()
    found = _kernels(z[kept], weights[kept] / weights[kept].sum(), INFLATION)
    if expected is None:
        return Proposal(count, np.array([prior_share, 1.0 - prior_share, 0.0]), found, found)
    half = 0.5 * (1.0 - prior_share)
    evenly = np.full(len(expected), 1.0 / len(expected))
    return Proposal(count, np.array([prior_share, half, half]), found, _kernels(expected, evenly, 1.0, NEIGHBOURS))


def _kernels(centers: np.ndarray, weights: np.ndarray, inflation: float, neighbours: float = np.inf) -> Kernels:
    """With Silverman's bandwidth of the centers' weighted covariance, times an inflation.

    It is less where about so many neighbours of a center lie within a narrower one: a ridge that bends stays narrow.
    """
    p = centers.shape[1]
    mean = weights @ centers
    spread = (centers - mean).T @ ((centers - mean) * weights[:, None])
    ess = max(effective_sample_size(weights), 2.0)
    factor = (4.0 / (p + 2.0)) ** (2.0 / (p + 4.0)) * ess ** (-2.0 / (p + 4.0)) * inflation**2
    factor = min(factor, (neighbours / ess) ** (2.0 / p))
    return Kernels(centers, weights, factor * spread + LEAST_SD**2 * np.eye(p))


def draw(rng: np.random.Generator, proposal: Proposal) -> np.ndarray:
    """(count, P) particles in probit space; stratified over the prior's share and over the kernels."""
    p = proposal.found.centers.shape[1]
    first, *others = proposal.drawn
    strata = np.stack([rng.permutation(first) for _ in range(p)], axis=1).reshape(first, p)
    parts = [to_probit((strata + rng.random((first, p))) / max(first, 1))]
    for count, kernels in zip(others, (proposal.found, proposal.expected), strict=True):
        if count:
            centers = kernels.centers[resample(rng, kernels.weights, count)]
            parts.append(centers + rng.standard_normal(centers.shape) @ np.linalg.cholesky(kernels.covariance).T)
    return np.concatenate(parts)


def log_prior(z: np.ndarray) -> np.ndarray:
    """(M,) log-density of the prior in probit space, without its constant."""
    return -0.5 * np.sum(z**2, axis=-1)


def log_density(proposal: Proposal, z: np.ndarray) -> np.ndarray:
    """(M,) log-density of a proposal at (M, P), without the constant that `log_prior` leaves out too."""
    first, *others = (n / proposal.size for n in proposal.drawn)
    parts = [np.log(first) + log_prior(z)] if first else []
    parts += [
        np.log(share) + log_kernels(z, *kernels)
        for share, kernels in zip(others, (proposal.found, proposal.expected), strict=True)
        if share
    ]
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
