"""The state that several baselines share: every particle simulated so far, and how far its trajectories lie off."""

from typing import NamedTuple

import numpy as np

from tcbi_infer.baselines.trajectory import Trajectories, distance, nothing, weights
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.proposal import from_probit


class Searched(NamedTuple):
    """Particles in the order of simulation."""

    generation: int
    z: np.ndarray  # (M, P) probit space
    seen: Trajectories
    scale: np.ndarray  # (O,) W of equation 8, from the first generation
    converged: bool


def begin(dimensions: int, real: Trajectories) -> Searched:
    """Nothing simulated yet."""
    return Searched(0, np.zeros((0, dimensions)), nothing(real), np.ones(real.absolute.shape[1]), False)


def extended(state: Searched, z: np.ndarray, seen: Trajectories) -> Searched:
    """With one more generation, of (N, P) particles.

    Raises:
      InferError: every simulation diverged.
    """
    together = state.seen.join(seen)
    if not together.valid.any():
        raise InferError(
            f"all {len(together.valid)} simulations diverged: the model is unstable over its whole prior; "
            "narrow the parameters' bounds or lower the time step"
        )
    scale = state.scale if state.generation else weights(seen)
    return Searched(state.generation + 1, np.concatenate([state.z, z]), together, scale, False)


def euclidean(state: Searched) -> np.ndarray:
    """(M,) mean squared distance of each particle's trajectories from the recorded ones (equation 5's L2)."""
    return distance(state.seen, state.scale, 0.0, 1.0)


def mean_distance(state: Searched, weights: np.ndarray) -> float:
    """Of particles with (M,) weights; those without weight may have diverged."""
    counted = weights > 0
    return float(weights[counted] @ euclidean(state)[counted])


def equally(z: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Particles (M, P) in [0, 1] and log-weights (M,), equal for those chosen (M,) and -inf for the rest."""
    with np.errstate(divide="ignore"):
        return from_probit(z), np.log(chosen / max(int(chosen.sum()), 1))
