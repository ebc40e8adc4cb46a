"""Neural posterior estimation as in BayesSim (Ramos et al. 2019): a mixture density network on summaries of rollouts.

All particles come from the prior; the network learns parameters given a summary (`trajectory`), and the posterior is
what it says of the recorded rollouts' summary. Trained anew after each generation, from the same start.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_infer.baselines.budget import Searched, begin, extended
from tcbi_infer.baselines.trajectory import Trajectories
from tcbi_infer.tcbi.proposal import draw, from_probit, prior_proposal

DRAWS = 1000


class NpeSettings(NamedTuple):
    """Budget and network."""

    particles: int = 50  # simulated in each generation, all from the prior
    generations: int = 6
    components: int = 4  # of the mixture
    hidden: int = 48  # units of each of two layers


class NpeState(NamedTuple):
    """Everything simulated, and the posterior that the network draws from it."""

    generation: int
    searched: Searched
    real: np.ndarray  # (K,) the recorded rollouts' summary
    draws: np.ndarray  # (N, P) probit space
    converged: bool


def init(dimensions: int, real: Trajectories) -> NpeState:
    """Nothing simulated yet."""
    return NpeState(0, begin(dimensions, real), real.summary[0], np.zeros((0, dimensions)), False)


def step(
    rng: np.random.Generator,
    state: NpeState,
    simulate: Callable[[np.ndarray], Trajectories],
    settings: NpeSettings,
) -> NpeState:
    """More draws of the prior, then train and ask."""
    from tcbi_infer.baselines.mixture_network import posterior_draws  # torch takes a second to import

    z = draw(rng, prior_proposal(settings.particles, state.searched.z.shape[1]))
    searched = extended(state.searched, z, simulate(from_probit(z)))
    usable = searched.seen.valid & np.isfinite(searched.seen.summary).all(axis=1)
    draws = posterior_draws(
        searched.seen.summary[usable],
        searched.z[usable],
        state.real,
        DRAWS,
        components=settings.components,
        hidden=settings.hidden,
        seed=int(rng.integers(2**31)),
    )
    return NpeState(state.generation + 1, searched, state.real, draws, False)


def posterior(state: NpeState) -> tuple[np.ndarray, np.ndarray]:
    """(N, P) draws in [0, 1] and (N,) equal log-weights."""
    return from_probit(state.draws), np.zeros(len(state.draws))
