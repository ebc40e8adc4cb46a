"""Fixed domain randomisation: the prior as it stands, whatever the rollouts say. Nothing is simulated."""

from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.proposal import draw, from_probit, prior_proposal


class PriorSettings(NamedTuple):
    """How many draws stand for it."""

    particles: int = 1000
    generations: int = 1


class PriorState(NamedTuple):
    """The draws."""

    generation: int
    z: np.ndarray  # (N, P) probit space
    converged: bool


def init(rng: np.random.Generator, dimensions: int, settings: PriorSettings) -> PriorState:
    """Stratified draws."""
    return PriorState(0, draw(rng, prior_proposal(settings.particles, dimensions)), False)


def step(state: PriorState) -> PriorState:
    """Nothing changes."""
    return state._replace(generation=state.generation + 1, converged=True)


def posterior(state: PriorState) -> tuple[np.ndarray, np.ndarray]:
    """(N, P) particles in [0, 1] and (N,) equal log-weights."""
    return from_probit(state.z), np.zeros(len(state.z))
