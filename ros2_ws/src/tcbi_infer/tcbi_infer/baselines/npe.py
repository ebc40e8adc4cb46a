"""Neural posterior estimation as in BayesSim (Ramos et al. 2019): a mixture density network on summaries of rollouts.

All particles come from the prior; the network learns parameters given a summary (`trajectory`), and the posterior is
what it says of the recorded rollouts' summary. It is trained once, after the last generation; what is drawn before that
is the prior.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_contract.errors import describe
from tcbi_infer.baselines.budget import Searched, begin, extended
from tcbi_infer.baselines.trajectory import Trajectories
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.proposal import draw, from_probit, prior_proposal

DRAWS = 1000
LEAST_USABLE = 5  # simulations to train on: one leaves no input that varies, and none to stop by


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
    draws: np.ndarray  # (N, P) probit space, of the prior until the network is trained
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
    """More draws of the prior; after the last ones train and ask.

    Raises:
      InferError: every simulation diverged, or too few are left to train on.
    """
    dimensions = state.searched.z.shape[1]
    z = draw(rng, prior_proposal(settings.particles, dimensions))
    searched = extended(state.searched, z, simulate(from_probit(z)))
    if searched.generation < settings.generations:
        draws = draw(rng, prior_proposal(DRAWS, dimensions))
    else:
        draws = _learnt(rng, searched, state.real, settings)
    return NpeState(searched.generation, searched, state.real, draws, False)


def _learnt(rng: np.random.Generator, searched: Searched, real: np.ndarray, settings: NpeSettings) -> np.ndarray:
    """(DRAWS, P) of what a network says that was trained on everything simulated."""
    from tcbi_infer.baselines.mixture_network import posterior_draws  # torch takes a second to import

    usable = searched.seen.valid & np.isfinite(searched.seen.summary).all(axis=1)
    if usable.sum() < LEAST_USABLE:
        raise InferError(
            describe(
                f"simulations of {len(usable)} that the network can be trained on",
                int(usable.sum()),
                f"{LEAST_USABLE} or more",
                "the others diverged: narrow the parameters' bounds, lower the time step, or simulate more particles",
            )
        )
    return posterior_draws(
        searched.seen.summary[usable],
        searched.z[usable],
        real,
        DRAWS,
        components=settings.components,
        hidden=settings.hidden,
        seed=int(rng.integers(2**31)),
    )


def posterior(state: NpeState) -> tuple[np.ndarray, np.ndarray]:
    """(N, P) draws in [0, 1] and (N,) equal log-weights."""
    return from_probit(state.draws), np.zeros(len(state.draws))
