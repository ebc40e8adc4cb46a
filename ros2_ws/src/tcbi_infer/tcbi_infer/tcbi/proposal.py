"""Proposals in probit space, where the flat prior is a standard normal and no bound needs care.

A unit value u in (0, 1) becomes z = Phi^-1(u). A proposal mixes a share of the prior (so that weights stay bounded
and no mode is lost for good) with normal kernels on the weighted particles; its density is exact, which is what makes
the weights of population Monte Carlo right.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from tcbi_infer.tcbi.weights import effective_sample_size, resample

EDGE = 1e-7  # closest a particle comes to its bounds, in shares of the range
INFLATION = 1.5  # on the kernel's standard deviation: a proposal should be wider than its target
LEAST_SD = 0.02  # of a kernel, in probit units


class Proposal(NamedTuple):
    """What one generation's particles were drawn from."""

    count: int  # particles drawn
    prior_share: float
    centers: np.ndarray  # (n, P), probit space
    weights: np.ndarray  # (n,), sum to one
    covariance: np.ndarray  # (P, P) of each kernel


def to_probit(unit: np.ndarray) -> np.ndarray:
    """(0, 1) -> the real line."""
    return ndtri(np.clip(unit, EDGE, 1 - EDGE))


def from_probit(z: np.ndarray) -> np.ndarray:
    """The real line -> (0, 1)."""
    return np.clip(ndtr(z), EDGE, 1 - EDGE)


def prior_proposal(count: int, dimensions: int) -> Proposal:
    """The first generation's: the prior alone."""
    return Proposal(count, 1.0, np.zeros((0, dimensions)), np.zeros(0), np.eye(dimensions))


def kernel_proposal(count: int, z: np.ndarray, weights: np.ndarray, prior_share: float) -> Proposal:
    """Kernels on the particles that carry weight, Silverman's bandwidth of their weighted covariance, inflated."""
    kept = weights > 1e-6 * weights.max()
    z, weights = z[kept], weights[kept] / weights[kept].sum()
    p = z.shape[1]
    mean = weights @ z
    spread = (z - mean).T @ ((z - mean) * weights[:, None])
    ess = max(effective_sample_size(weights), 2.0)
    factor = (4.0 / (p + 2.0)) ** (2.0 / (p + 4.0)) * ess ** (-2.0 / (p + 4.0)) * INFLATION**2
    return Proposal(count, prior_share, z, weights, factor * spread + LEAST_SD**2 * np.eye(p))


def draw(rng: np.random.Generator, proposal: Proposal) -> np.ndarray:
    """(count, P) particles in probit space; stratified over the prior's share and over the kernels."""
    p = proposal.covariance.shape[0]
    from_prior = proposal.count if len(proposal.weights) == 0 else round(proposal.prior_share * proposal.count)
    strata = np.stack([rng.permutation(from_prior) for _ in range(p)], axis=1).reshape(from_prior, p)
    prior = to_probit((strata + rng.random((from_prior, p))) / max(from_prior, 1))
    if from_prior == proposal.count:
        return prior
    centers = proposal.centers[resample(rng, proposal.weights, proposal.count - from_prior)]
    step = rng.standard_normal(centers.shape) @ np.linalg.cholesky(proposal.covariance).T
    return np.concatenate([prior, centers + step])


def log_prior(z: np.ndarray) -> np.ndarray:
    """(M,) log-density of the prior in probit space, without its constant."""
    return -0.5 * np.sum(z**2, axis=-1)


def log_density(proposal: Proposal, z: np.ndarray) -> np.ndarray:
    """(M,) log-density of a proposal at (M, P), without the constant that `log_prior` leaves out too."""
    prior = log_prior(z)
    share = 1.0 if len(proposal.weights) == 0 else round(proposal.prior_share * proposal.count) / proposal.count
    if len(proposal.weights) == 0 or share >= 1.0:
        return prior
    cholesky = np.linalg.cholesky(proposal.covariance)
    whitened = np.linalg.solve(cholesky, (z[:, None] - proposal.centers).reshape(-1, z.shape[1]).T).T
    squares = np.sum(whitened**2, axis=-1).reshape(len(z), -1)
    kernels = logsumexp(-0.5 * squares, b=proposal.weights, axis=1) - np.log(np.diag(cholesky)).sum()
    with np.errstate(divide="ignore"):
        return np.logaddexp(np.log(share) + prior, np.log1p(-share) + kernels)


def log_mixture(proposals: tuple[Proposal, ...], z: np.ndarray) -> np.ndarray:
    """(M,) log-density of all proposals together, each by its count (deterministic-mixture weights)."""
    total = sum(proposal.count for proposal in proposals)
    parts = [np.log(proposal.count / total) + log_density(proposal, z) for proposal in proposals]
    return logsumexp(np.stack(parts), axis=0)
