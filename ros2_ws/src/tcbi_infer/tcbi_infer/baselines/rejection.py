"""Rejection ABC on trajectories (Csillery et al. 2010): of all draws of the prior, those with the nearest trajectories.

Written on the batch engine: libraries (pyABC among them) call a simulator particle by particle, which costs more than
the ten lines that are needed.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_infer.baselines.budget import Searched, equally, euclidean, extended
from tcbi_infer.baselines.trajectory import Trajectories
from tcbi_infer.tcbi.proposal import draw, from_probit, prior_proposal


class RejectionSettings(NamedTuple):
    """Budget, and how much of it is accepted."""

    particles: int = 50  # simulated in each generation, all from the prior
    generations: int = 6
    accepted: float = 0.1  # share of all particles


def step(
    rng: np.random.Generator,
    state: Searched,
    simulate: Callable[[np.ndarray], Trajectories],
    settings: RejectionSettings,
) -> Searched:
    """More draws of the prior."""
    z = draw(rng, prior_proposal(settings.particles, state.z.shape[1]))
    return extended(state, z, simulate(from_probit(z)))


def posterior(state: Searched, settings: RejectionSettings) -> tuple[np.ndarray, np.ndarray]:
    """(M, P) particles in [0, 1] and (M,) log-weights, -inf for those rejected."""
    far = euclidean(state)
    keep = max(2, round(settings.accepted * len(far)))
    return equally(state.z, np.isin(np.arange(len(far)), np.argsort(far, kind="stable")[:keep]) & np.isfinite(far))
