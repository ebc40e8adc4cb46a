"""What is believed before these rollouts: the flat prior of the parameters, or what a model version already says.

Methods work on a cube in which the prior is uniform. With a flat prior that is the unit cube of the parameters itself;
else the cube is mapped by a normal distribution, fitted to the model's particles on the probit scale.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_infer.tcbi.proposal import from_probit, to_probit
from tcbi_infer.tcbi.weights import mean_and_variance
from tcbi_sim.model import Model

DIAGNOSIS = "diagnosis"  # the kind of evidence that `tcbi_infer.diagnose.adopt` writes
FLAT, MODEL = "flat", "model"
DRAWS = 4000  # that stand for the prior
AFTER_DIAGNOSIS = 2.0  # on the standard deviation; see `Prior.of`
LEAST_VARIANCE = 1e-6  # on the probit scale, so that a parameter that is known still moves


@dataclass(frozen=True)
class Prior:
    """A normal distribution on the probit scale."""

    mean: np.ndarray  # (P,)
    root: np.ndarray  # (P, P), Cholesky factor of the covariance

    @staticmethod
    def of(model: Model) -> "Prior":
        """What a model version's particles say, made wider where a diagnosis drew them.

        A diagnosis's 90 % intervals held the size of an effect in 11 of 15 emulated robots (docs/diagnosis.md). Were
        the errors normal, its spread would be 1.5 times too small, and 2.2 times if the share is at the lower end of
        what 11 of 15 allow (one-sided, 90 %). Hence twice, but in no direction wider than the flat prior.
        """
        z = to_probit(model.to_unit(model.particles))
        mean, _ = mean_and_variance(z, model.weights)
        centred = z - mean
        covariance = (centred * model.weights[:, None]).T @ centred + LEAST_VARIANCE * np.eye(len(mean))
        if model.evidence.get("kind") == DIAGNOSIS:
            values, vectors = np.linalg.eigh(AFTER_DIAGNOSIS**2 * covariance)
            covariance = (vectors * np.minimum(values, 1.0)) @ vectors.T
        return Prior(mean, np.linalg.cholesky(covariance))

    def draws(self) -> np.ndarray:
        """(N, P) in the parameters' unit cube."""
        return self.unit(np.random.default_rng(0).random((DRAWS, len(self.mean))))

    def unit(self, cube: np.ndarray) -> np.ndarray:
        """(N, P) in the cube -> (N, P) in the parameters' unit cube."""
        return from_probit(self.mean + to_probit(cube) @ self.root.T)


def about(model: Model, prior: str) -> list[str]:
    """What a user should know of the prior."""
    if prior == MODEL and model.evidence.get("kind") == DIAGNOSIS:
        wider = f"{AFTER_DIAGNOSIS:g} times as wide as the diagnosis left it, whose intervals are too narrow"
        return [f"the prior is what {model.version} says, {wider} (docs/tcbi.md)"]
    return []
