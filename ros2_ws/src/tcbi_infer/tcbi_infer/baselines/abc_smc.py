"""ABC-SMC on trajectories, in the form that spends a fixed number of simulations in each generation.

Adaptive population Monte Carlo ABC (Lenormand, Jabot and Deffuant 2013): each generation perturbs the population with
a normal kernel of twice its weighted covariance, simulates, and keeps the nearer half of old and new particles; the
tolerance is the distance of the farthest one kept. A particle weighs prior / proposal. It ends when few of the new ones
get in. pyABC's own (Toni et al. 2009) simulates until a population is full, one particle a call.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_infer.baselines.trajectory import Trajectories, distance, nothing, weights
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.proposal import draw, from_probit, log_kernels, log_prior, prior_proposal
from tcbi_infer.tcbi.weights import normalised, resample

RIDGE = 1e-6  # on the kernel's covariance, so that a population of equal values still moves


class AbcSmcSettings(NamedTuple):
    """Budget and end."""

    particles: int = 50  # simulated in each generation
    generations: int = 6
    kept: float = 0.5  # share of `particles` that the first population keeps
    least_accepted: float = 0.05  # share of the new particles, below which it has converged


class AbcSmcState(NamedTuple):
    """The population."""

    generation: int
    z: np.ndarray  # (N, P) probit space
    log_weights: np.ndarray  # (N,) prior / proposal
    seen: Trajectories
    scale: np.ndarray  # (O,) W of equation 8, from the first generation
    tolerance: float
    converged: bool


def begin(dimensions: int, real: Trajectories) -> AbcSmcState:
    """Nothing simulated yet."""
    return AbcSmcState(
        0, np.zeros((0, dimensions)), np.zeros(0), nothing(real), np.ones(real.absolute.shape[1]), np.inf, False
    )


def step(
    rng: np.random.Generator,
    state: AbcSmcState,
    simulate: Callable[[np.ndarray], Trajectories],
    settings: AbcSmcSettings,
) -> AbcSmcState:
    """Perturb, simulate, keep the nearer ones.

    Raises:
      InferError: every simulation diverged.
    """
    n, p = settings.particles, state.z.shape[1]
    if state.generation == 0:
        fresh, log_weights = draw(rng, prior_proposal(n, p)), np.zeros(n)
    else:
        fresh, log_weights = _perturbed(rng, state, n)
    seen = simulate(from_probit(fresh))
    scale = state.scale if state.generation else weights(seen)
    z, log_weights = np.concatenate([state.z, fresh]), np.concatenate([state.log_weights, log_weights])
    seen = state.seen.join(seen)
    far = distance(seen, scale, 0.0, 1.0)
    if not np.isfinite(far).any():
        raise InferError(
            f"all {len(far)} simulations diverged: the model is unstable over its whole prior; "
            "narrow the parameters' bounds or lower the time step"
        )
    kept = np.argsort(far, kind="stable")[: max(2, round(settings.kept * n))]
    kept = kept[np.isfinite(far[kept])]
    accepted = float(np.mean(kept >= len(state.z))) * len(kept) / n
    return AbcSmcState(
        state.generation + 1,
        z[kept],
        log_weights[kept],
        Trajectories(*(part[kept] for part in seen)),
        scale,
        float(far[kept[-1]]),
        bool(state.generation > 0 and accepted < settings.least_accepted),
    )


def _perturbed(rng: np.random.Generator, state: AbcSmcState, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, P) proposals and their (n,) log-weights."""
    population = normalised(state.log_weights)
    centred = state.z - population @ state.z
    covariance = 2 * (centred * population[:, None]).T @ centred + RIDGE * np.eye(state.z.shape[1])
    parents = state.z[resample(rng, population, n)]
    fresh = parents + rng.standard_normal(parents.shape) @ np.linalg.cholesky(covariance).T
    return fresh, log_prior(fresh) - log_kernels(fresh, state.z, population, covariance)


def posterior(state: AbcSmcState) -> tuple[np.ndarray, np.ndarray]:
    """(N, P) particles in [0, 1] and (N,) log-weights."""
    return from_probit(state.z), state.log_weights


def mean_distance(state: AbcSmcState, weights: np.ndarray) -> float:
    """Of the population with (N,) weights."""
    return float(weights @ distance(state.seen, state.scale, 0.0, 1.0))
