"""What is believed before these rollouts: the flat prior of the parameters, or what a model version already says.

Methods work on a cube in which the prior is uniform. With a flat prior that is the unit cube of the parameters itself;
else the cube is mapped by a normal distribution, fitted to the model's particles on the probit scale, or by one for
each of their separate modes (`modes`): the cube's first coordinate then says which, and where within it.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.modes import modes, told
from tcbi_infer.tcbi.proposal import from_probit, to_probit
from tcbi_infer.tcbi.weights import effective_sample_size
from tcbi_sim.model import Model

DIAGNOSIS = "diagnosis"  # the kind of evidence that `tcbi_infer.diagnose.adopt` writes
NO_WIDTH = ("paper", "rejection", "abc_smc", "simopt", "bayesopt")  # methods whose spread is not what data leave open
FEW = 10  # effective particles, below which a width is a guess
FLAT, MODEL = "flat", "model"
DRAWS = 4000  # that stand for the prior
AFTER_DIAGNOSIS = 2.0  # on the standard deviation; see `Prior.of`
LEAST_VARIANCE = 1e-6  # on the probit scale, so that a parameter that is known still moves


@dataclass(frozen=True)
class Prior:
    """A normal distribution on the probit scale for each of K modes."""

    shares: np.ndarray  # (K,), sum to one
    means: np.ndarray  # (K, P)
    root: np.ndarray  # (P, P), Cholesky factor of the covariance, one for all modes: few particles make each

    @staticmethod
    def of(model: Model) -> "Prior":
        """What a model version's particles say, made wider where a diagnosis drew them.

        Twice, but in no direction wider than the flat prior. That was chosen when a diagnosis's 90 % intervals held the
        size of an effect in 11 of 15 emulated robots. They have held it in 63 of 68 since (docs/diagnosis_measured.md,
        Intervals), so that it is cautious.

        Raises:
          InferError: the particles are one point.
        """
        z = to_probit(model.to_unit(model.particles))
        parts = modes(z, model.weights)
        shares = np.array([model.weights[part].sum() for part in parts])
        means = np.array([model.weights[part] @ z[part] for part in parts]) / shares[:, None]
        covariance = np.zeros((z.shape[1], z.shape[1]))
        for part, mean in zip(parts, means, strict=True):
            covariance += ((z[part] - mean) * model.weights[part][:, None]).T @ (z[part] - mean)
        if np.max(np.diag(covariance)) < LEAST_VARIANCE:
            by = f" ({model.fit.by} made it)" if model.fit.by else ""
            raise InferError(
                f"{model.version} is one point and no distribution{by}: as a prior it would leave nothing open; "
                "take the flat prior"
            )
        covariance += LEAST_VARIANCE * np.eye(len(covariance))
        if model.fit.by == DIAGNOSIS:
            values, vectors = np.linalg.eigh(AFTER_DIAGNOSIS**2 * covariance)
            covariance = (vectors * np.minimum(values, 1.0)) @ vectors.T
        return Prior(shares / shares.sum(), means, np.linalg.cholesky(covariance))

    def draws(self) -> np.ndarray:
        """(N, P) in the parameters' unit cube."""
        return self.unit(np.random.default_rng(0).random((DRAWS, len(self.root))))

    def unit(self, cube: np.ndarray) -> np.ndarray:
        """(N, P) in the cube -> (N, P) in the parameters' unit cube."""
        ends = np.cumsum(self.shares)
        mode = np.minimum(np.searchsorted(ends, cube[:, 0]), len(ends) - 1)
        first = (cube[:, 0] - (ends - self.shares)[mode]) / self.shares[mode]
        return from_probit(self.means[mode] + to_probit(np.column_stack([first, cube[:, 1:]])) @ self.root.T)


def doubtful(model: Model) -> bool:
    """Whether a version's own fit gives reason to doubt it, so that nothing that rests on it is sure."""
    return model.fit.fits is not True


def about(model: Model, prior: str) -> list[str]:
    """What a user should know of the prior."""
    if prior != MODEL:
        return []
    lines, fit = [], model.fit
    if fit.by in NO_WIDTH:
        lines.append(
            f"the prior is as wide as the method {fit.by} left {model.version}, whose width is not what its rollouts "
            "leave open; take the flat prior to be safe (docs/tcbi.md)"
        )
    if fit.fits is False:
        lines.append(f"the prior is doubtful: {model.version} did not fit the rollouts that it comes from")
    if fit.fits is None:
        lines.append(f"the prior is doubtful: too few simulations made {model.version} to tell whether it fits")
    if (ess := effective_sample_size(model.weights)) < FEW:
        lines.append(f"the prior's width is a guess: {model.version} has {ess:.0f} effective particles")
    if fit.by == DIAGNOSIS:
        wider = f"{AFTER_DIAGNOSIS:g} times as wide as the diagnosis left it, to be cautious"
        lines.append(f"the prior is what {model.version} says, {wider} (docs/tcbi.md)")
    several = told(model.parameters, model.to_unit(model.particles), model.weights)
    return [*lines, f"the prior keeps what {model.version} left open: {several}"] if several else lines
