"""What an inference found: weighted particles, a table with a verdict per parameter, and what a user must know."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from tcbi_infer.tcbi.weights import effective_sample_size, mean_and_variance, normalised, quantiles, resample
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

FLAT_VARIANCE = 1.0 / 12.0  # of a flat prior on [0, 1]
IDENTIFIED_BELOW = 0.5  # of the prior's variance, with 95 % confidence
LEAST_ESS = 10  # effective particles, below which nothing is said about what the data tell


@dataclass(frozen=True)
class Estimate:
    """One parameter's posterior, in physical units."""

    name: str
    unit: str
    mean: float
    sd: float
    low90: float
    high90: float
    prior_sd: float
    variance_ratio: float  # posterior over prior variance, on the parameter's scale
    identified: bool  # whether the data say something about it

    def as_json(self) -> dict[str, Any]:
        """As the contract has it, and a little more."""
        keys = ("name", "unit", "mean", "sd", "low90", "high90", "identified", "variance_ratio")
        return {key: getattr(self, key) for key in keys}


@dataclass(frozen=True)
class Result:
    """The outcome of one inference."""

    model: Model  # whose structure was inferred
    method: str
    task: str
    statistics: tuple[str, ...]
    rollouts: tuple[str, ...]
    unit: np.ndarray  # (M, P) in [0, 1]
    log_weights: np.ndarray  # (M,) normalised
    estimates: tuple[Estimate, ...]
    ess: float  # effective sample size of the distinct particles
    simulations: int  # rollouts simulated
    seconds: float  # wall time of all generations, those before it was resumed among them
    generations: tuple[dict[str, Any], ...]  # one entry each: mean, variance, ess, alpha, divergence, wall_s; the last
    # one has the moments of this posterior
    converged: bool
    closed_loop: bool
    warnings: tuple[str, ...]
    prior: np.ndarray | None = None  # (N, P) draws in [0, 1] of the prior that was used; None for the flat one
    fits: bool | None = True  # no sign that the model is wrong; None: the search was too short to tell
    state: Path | None = None  # from which an interrupted inference goes on; of no use once this is saved
    settings: Mapping[str, Any] = field(default_factory=dict)  # seed, timestep (s), the method's own, versions

    @property
    def particles(self) -> np.ndarray:
        """(M, P) physical values."""
        return self.model.from_unit(self.unit)

    @property
    def divergence(self) -> dict[str, float]:
        """Weighted mean divergence of each statistic, at the end."""
        values = self.generations[-1]["divergence"] if self.generations else []
        return dict(zip(self.statistics, values, strict=False))

    def draws(self, count: int, seed: int = 0) -> np.ndarray:
        """(count, P) equally weighted physical values."""
        rng = np.random.default_rng(seed)
        return self.particles[rng.permutation(resample(rng, np.exp(self.log_weights), count))]

    def forget_state(self) -> None:
        """Remove the state from which an interrupted inference goes on."""
        if self.state is not None:
            self.state.unlink(missing_ok=True)

    def updated_model(self) -> Model:
        """An unsaved child of the model whose particles are the posterior, with the evidence that made it."""
        seen = [] if self.prior is None else self.model.fit.rollouts
        return self.model.with_particles(
            self.particles,
            self.log_weights,
            inference={
                "method": self.method,
                "task": self.task,
                "rollouts": list(self.rollouts),
                "statistics": list(self.statistics),
                "closed_loop": self.closed_loop,
                "settings": dict(self.settings),
                "prior": "flat" if self.prior is None else self.model.version,
                "fits": self.fits,
                "parameters": [e.as_json() for e in self.estimates],
                "ess": self.ess,
                "simulations": self.simulations,
                "seconds": self.seconds,
                "converged": self.converged,
                "warnings": list(self.warnings),
            },
            **({"kept": {"rollouts": seen}} if seen else {}),
        )


def estimates(
    parameters: Sequence[Parameter],
    unit: np.ndarray,
    log_weights: np.ndarray,
    prior: np.ndarray | None = None,
    judged: bool = True,
) -> tuple[Estimate, ...]:
    """The table.

    Args:
      parameters: P.
      unit: (M, P) particles in [0, 1].
      log_weights: (M,).
      prior: (N, P) draws of it, None for flat.
      judged: whether the particles' spread is what the data leave open; if not, no parameter is called identified.
    """
    weights = normalised(log_weights)
    enough = judged and effective_sample_size(weights) >= LEAST_ESS
    before = prior_variances(len(parameters), prior)
    _, variance = mean_and_variance(unit, weights)
    high = _variance_bound(unit, weights)
    sds = prior_sds(parameters, prior)
    rows = []
    for i, p in enumerate(parameters):
        values = p.from_unit(unit[:, i])
        mean, spread = mean_and_variance(values[:, None], weights)
        low90, high90 = quantiles(values[:, None], weights, [0.05, 0.95])[:, 0]
        rows.append(
            Estimate(
                p.name,
                p.unit,
                float(mean[0]),
                float(np.sqrt(spread[0])),
                float(low90),
                float(high90),
                sds[i],
                float(variance[i] / before[i]),
                bool(enough and high[i] / before[i] < IDENTIFIED_BELOW),
            )
        )
    return tuple(rows)


def prior_variances(count: int, prior: np.ndarray | None = None) -> np.ndarray:
    """(count,) in [0, 1] before the data: of (N, count) draws, or flat."""
    return np.full(count, FLAT_VARIANCE) if prior is None else prior.var(axis=0)


def prior_sds(parameters: Sequence[Parameter], prior: np.ndarray | None = None) -> list[float]:
    """Standard deviation of each parameter in its unit before the data: of (N, P) draws in [0, 1], or flat."""
    draws = np.tile((np.arange(1000)[:, None] + 0.5) / 1000, len(parameters)) if prior is None else prior
    return [float(p.from_unit(draws[:, i]).std()) for i, p in enumerate(parameters)]


def _variance_bound(unit: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Upper 95 % bound (P,) of the variance, as if the effective sample size were draws of a normal distribution."""
    size = max(effective_sample_size(weights), 2.0)
    _, variance = mean_and_variance(unit, weights)
    return variance * size / (2.0 * gammaincinv((size - 1) / 2.0, 0.05))  # quantile of chi-squared
