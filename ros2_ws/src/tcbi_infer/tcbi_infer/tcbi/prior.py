"""What is believed before these rollouts: the flat prior of the parameters, or what a model version already says.

Methods work on a cube in which the prior is uniform. With a flat prior that is the unit cube of the parameters itself;
else the cube is mapped by a normal distribution, fitted to the model's particles on the probit scale.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_infer.tcbi.proposal import from_probit, to_probit
from tcbi_infer.tcbi.weights import mean_and_variance
from tcbi_sim.model import Model

FLAT, MODEL = "flat", "model"
LEAST_VARIANCE = 1e-6  # on the probit scale, so that a parameter that is known still moves


@dataclass(frozen=True)
class Prior:
    """A normal distribution on the probit scale."""

    mean: np.ndarray  # (P,)
    root: np.ndarray  # (P, P), Cholesky factor of the covariance

    @staticmethod
    def of(model: Model) -> "Prior":
        """What a model version's particles say."""
        z = to_probit(model.to_unit(model.particles))
        mean, _ = mean_and_variance(z, model.weights)
        centred = z - mean
        covariance = (centred * model.weights[:, None]).T @ centred + LEAST_VARIANCE * np.eye(len(mean))
        return Prior(mean, np.linalg.cholesky(covariance))

    def unit(self, cube: np.ndarray) -> np.ndarray:
        """(N, P) in the cube -> (N, P) in the parameters' unit cube."""
        return from_probit(self.mean + to_probit(cube) @ self.root.T)
