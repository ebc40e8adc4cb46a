"""Task-Consistent Bayesian Inference as published: Algorithm 1 line by line ("line 5" in a comment is its line 5).

What Algorithm 1 leaves open, and how it is read here:

- The discrepancy `D_i` of several statistics is the sum over statistics of the mean over each one's channels.
- Line 5's index of the parent is that of the particle that was drawn.
- Priors are the model's; that of the servos' gain is uniform in its logarithm, where section 3 samples uniformly.
- The thresholds of convergence are 0.01: the paper gives none.
- `sigma` is in shares of each parameter's prior range (on the parameter's scale); a step over a bound is reflected, so
  that no particle leaves the prior. Neither sigma nor tau has a value in the paper.
- The reward has a sample per control step, as section 3 collects (s, a, r) at each t. Table 2 ("reward distribution
  sample size", 20, over random environments) can also be read as one per rollout.
- The ratio of contact time has a sample per foot and window of 2 s: a value per rollout would be as few samples as
  rollouts. The paper names no window.
- Lines 1 and 7 estimate distributions by histograms of 20 bins (`tcbi_infer.divergence`).
- Simulated readings have the sensors' noise, and are averaged where the robot's are (`Problem.read`).
- The policy acts in rollouts of a trained policy; a scripted gait, which does not react, is replayed (`loop`).
- A particle of which a rollout diverges weighs nothing.
- Convergence: "when the difference between the current and the previous iteration of the posterior mean value is below
  a threshold", "also confirmed ... when improvement of the task reward is below a threshold": both must hold; where the
  reward is unknown, the first alone.

Nothing corrects the weights for the proposal (line 9), and the same rollouts weigh again in each generation: the
variance shrinks with the number of generations, whatever the data say. `calibrated` is the honest reading.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.features import Features, Observed, weighable
from tcbi_infer.tcbi.weights import effective_sample_size, mean_and_variance, normalised


class PaperSettings(NamedTuple):
    """Algorithm 1's inputs, with the values of Table 2 where it has one."""

    particles: int = 50  # N
    generations: int = 15  # T
    alpha: float = 10.0
    sigma: float = 0.05  # share of the prior's range
    tau: float = 0.5
    mean_threshold: float = 0.01  # share of the prior's range
    reward_threshold: float = 0.01  # share of the reward


class PaperState(NamedTuple):
    """Particles after a generation."""

    generation: int
    particles: np.ndarray  # (N, P) in [0, 1]
    weights: np.ndarray  # (N,) sum to one
    mean: np.ndarray  # (P,) of the posterior
    reward: float  # weighted mean over particles, NaN if unknown
    converged: bool


class PaperInfo(NamedTuple):
    """What happened in a generation."""

    divergence: np.ndarray  # (statistics,) weighted mean over particles
    ess: float  # before resampling
    alpha: float
    resampled: bool


def init(rng: np.random.Generator, dimensions: int, settings: PaperSettings) -> PaperState:
    """Line 2; line 1, the distributions of the real rollouts, is `Problem.observed`."""
    particles = rng.random((settings.particles, dimensions))  # line 2: sample particles from the prior
    weights = np.full(settings.particles, 1 / settings.particles)  # line 2: w_i = 1/N
    return PaperState(0, particles, weights, particles.mean(axis=0), np.nan, False)


def step(
    rng: np.random.Generator,
    state: PaperState,
    simulate: Callable[[np.ndarray], Features],
    observed: Observed,
    settings: PaperSettings,
) -> tuple[PaperState, PaperInfo]:
    """One pass of lines 4 to 12.

    Args:
      rng: the randomness of this generation.
      state: after the previous generation.
      simulate: (N, P) in [0, 1] -> features, whose `divergence` is that of line 8 (lines 6 to 8).
      observed: the real rollouts.
      settings: Algorithm 1's inputs.

    Raises:
      InferError: every simulation diverged, or none has a finite divergence.
    """
    n = settings.particles
    parents = rng.choice(n, size=n, p=state.weights)  # line 5: resample ...
    noise = settings.sigma * rng.standard_normal(state.particles.shape)
    particles = reflected(state.particles[parents] + noise)  # line 5: ... and perturb
    features = simulate(particles)  # line 6: simulate; line 7: estimate distributions
    usable = weighable(features, observed.channels)
    divergence = observed.by_statistic(np.where(usable[:, None], features.divergence, 0.0))  # line 8: Jensen-Shannon
    discrepancy = np.where(usable, divergence.sum(axis=1), np.inf)
    spared = np.where(usable, discrepancy, 0.0)  # alpha may be 0, and 0 x inf is no weight
    weights = normalised(
        np.where(usable, -settings.alpha * spared, -np.inf)
    )  # line 9: w_i = exp(-alpha D_i); line 10: normalise
    ess = effective_sample_size(weights)  # line 11
    mean, _ = mean_and_variance(particles, weights)
    reward = _weighted_reward(features.reward, weights)
    info = PaperInfo(weights @ divergence, ess, settings.alpha, ess < settings.tau * n)
    if info.resampled:  # line 12
        particles = particles[rng.choice(n, size=n, p=weights)]
        weights = np.full(n, 1 / n)
    converged = state.generation > 0 and _converged(state, mean, reward, settings)
    return PaperState(state.generation + 1, particles, weights, mean, reward, converged), info


def finished(state: PaperState, settings: PaperSettings) -> bool:
    """Line 3's bound, or convergence."""
    return state.converged or state.generation >= settings.generations


def posterior(state: PaperState) -> tuple[np.ndarray, np.ndarray]:
    """Line 13: (N, P) particles in [0, 1] and (N,) log-weights."""
    with np.errstate(divide="ignore"):
        return state.particles, np.log(state.weights)


def reflected(unit: np.ndarray) -> np.ndarray:
    """Values folded back into [0, 1] at its ends."""
    folded = np.mod(unit, 2.0)
    return np.where(folded > 1.0, 2.0 - folded, folded)


def _weighted_reward(reward: np.ndarray, weights: np.ndarray) -> float:
    known = np.isfinite(reward) & (weights > 0)
    return float(reward[known] @ weights[known] / weights[known].sum()) if known.any() else np.nan


def _converged(before: PaperState, mean: np.ndarray, reward: float, settings: PaperSettings) -> bool:
    steady = bool(np.all(np.abs(mean - before.mean) < settings.mean_threshold))
    if not np.isfinite(reward) or not np.isfinite(before.reward):
        return steady
    improvement = (reward - before.reward) / max(abs(before.reward), 1e-12)
    return steady and improvement < settings.reward_threshold
