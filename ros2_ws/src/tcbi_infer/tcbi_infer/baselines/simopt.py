"""SimOpt (Chebotar et al. 2019): a Gaussian over the parameters, moved by relative entropy policy search.

Each generation draws from the Gaussian, costs every draw by equation 8, weighs it by equation 7, where the temperature
solves REPS's dual under a bound on the Kullback-Leibler divergence, and fits the next Gaussian by weighted maximum
likelihood (equation 6 is what this descends). The weights 0.5 and 1, the threshold of the discrepancy (0.06) and the
least temperature (0.04) are Table 2's; the bound, which it does not give, is that of SimOpt's authors. Table 2's 1200
samples an update are `particles`; here 50, the budget of the other methods, are the default.

W of equation 8 is one over the distance of the first generation's trajectories, so that costs begin near 1. The
Gaussian lives in probit space, where the flat prior is a standard normal: it begins as the prior, and no bound needs
care. Its width says where the optimiser still looks, which is not what the data leave open.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from tcbi_infer.baselines.trajectory import Trajectories, distance, weights
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.proposal import from_probit
from tcbi_infer.tcbi.weights import effective_sample_size, normalised

DRAWS = 1000  # that stand for the Gaussian
RIDGE = 1e-6  # on its covariance


class SimOptSettings(NamedTuple):
    """Budget and constants."""

    particles: int = 50  # simulated in each generation
    generations: int = 6
    kl_bound: float = 1.0  # nats, between a generation's weights and equal ones
    least_temperature: float = 0.04
    threshold: float = 0.06  # weighted mean discrepancy at which it has converged
    l1: float = 0.5
    l2: float = 1.0


class SimOptState(NamedTuple):
    """The Gaussian after a generation."""

    generation: int
    mean: np.ndarray  # (P,) probit space
    covariance: np.ndarray  # (P, P)
    scale: np.ndarray  # (O,) W of equation 8
    discrepancy: float  # weighted mean of the last generation
    ess: float
    converged: bool


def begin(dimensions: int, real: Trajectories) -> SimOptState:
    """The prior."""
    eye = np.eye(dimensions)
    return SimOptState(0, np.zeros(dimensions), eye, np.ones(real.absolute.shape[1]), np.nan, np.nan, False)


def step(
    rng: np.random.Generator,
    state: SimOptState,
    simulate: Callable[[np.ndarray], Trajectories],
    settings: SimOptSettings,
) -> SimOptState:
    """Draw, simulate, weigh, fit.

    Raises:
      InferError: every simulation diverged.
    """
    n, p = settings.particles, len(state.mean)
    z = state.mean + rng.standard_normal((n, p)) @ np.linalg.cholesky(state.covariance).T
    seen = simulate(from_probit(z))
    scale = state.scale if state.generation else weights(seen)
    cost = distance(seen, scale, settings.l1, settings.l2)
    usable = np.isfinite(cost)
    if not usable.any():
        raise InferError(
            f"all {n} simulations diverged: the model is unstable over its whole prior; "
            "narrow the parameters' bounds or lower the time step"
        )
    z, cost = z[usable], cost[usable]
    temperature = solved_temperature(cost, settings.kl_bound, settings.least_temperature)
    share = normalised(-cost / temperature)  # equation 7
    mean = share @ z
    centred = z - mean
    fitted = (centred * share[:, None]).T @ centred + RIDGE * np.eye(p)
    covariance = fitted if len(z) > 2 * p else state.covariance  # where nearly all diverged, the rest tell no spread
    discrepancy = float(share @ cost)
    return SimOptState(
        state.generation + 1,
        mean,
        covariance,
        scale,
        discrepancy,
        effective_sample_size(share),
        discrepancy < settings.threshold,
    )


def solved_temperature(cost: np.ndarray, bound: float, least: float) -> float:
    """eta that minimises REPS's dual, eta bound + eta log mean exp(-cost / eta), and is at least `least`.

    Args:
      cost: (N,) of the draws.
      bound: on the divergence of the weights from equal ones, nats.
      least: eta, below which weights would rest on one draw.
    """
    cost = cost - cost.min()

    def dual(log_eta: float) -> float:
        eta = np.exp(log_eta)
        return eta * bound + eta * (logsumexp(-cost / eta) - np.log(len(cost)))

    spread = max(float(np.ptp(cost)), least)
    found = minimize_scalar(dual, bounds=(np.log(least), np.log(1e3 * spread)), method="bounded")
    return float(np.exp(found.x))


def posterior(state: SimOptState) -> tuple[np.ndarray, np.ndarray]:
    """(N, P) draws of the Gaussian in [0, 1] and (N,) equal log-weights."""
    normal = np.random.default_rng(0).standard_normal((DRAWS, len(state.mean)))
    return from_probit(state.mean + normal @ np.linalg.cholesky(state.covariance).T), np.zeros(DRAWS)
