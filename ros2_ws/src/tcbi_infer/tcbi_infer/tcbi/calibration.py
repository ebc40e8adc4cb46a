"""How sharply divergences may weigh particles: their noise floors, and alpha.

The pseudo-likelihood of a particle is exp(-alpha E), where the energy E sums over statistics the mean over channels of
divergence / floor. Three things decide:

- *Noise.* Part of a channel's divergence remains with the right parameters, because rollouts are few. How the residuals
  differ between rollouts says how much (`residual_noise`). It is spread over some degrees of freedom, the bins in use;
  a right likelihood falls by 1/2 when a divergence rises by one degree's share, hence `LARGEST_ALPHA` = 1/2.
- *Misfit.* What the best particles cannot remove beyond the noise is systematic and shared by all rollouts, so nothing
  averages it: it counts in full. A model that does not fit thus widens its own posterior.
- *Rollouts.* What would other rollouts have said? The real ones are resampled with replacement (and with them the
  simulations of the same scenarios: they are paired). The posterior mean moves from resample to resample; alpha is the
  largest at which it moves no more than the posterior is wide (general posterior calibration, Syring and Martin 2019).
"""

from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.features import Observed, resampled_divergences
from tcbi_infer.tcbi.weights import mean_and_variance, normalised

LARGEST_ALPHA = 0.5
RESAMPLES = 40
MOST_PARTICLES = 300  # used in calibration, evenly from the best to the worst
BEST = 5  # particles that show what divergence remains


class Floors(NamedTuple):
    """Divergence per channel below which differences mean nothing."""

    noise: np.ndarray  # (C,) expected of a right model, from how residuals vary between rollouts
    freedom: np.ndarray  # (C,) degrees of freedom that the noise is spread over
    misfit: np.ndarray  # (C,) what the best particles cannot remove

    @property
    def total(self) -> np.ndarray:
        """(C,) what divergences are divided by, positive."""
        return np.maximum(self.noise / self.freedom + np.maximum(self.misfit - self.noise, 0.0), 1e-9)


def effective_bins(counts: np.ndarray) -> np.ndarray:
    """(C,) degrees of freedom of (U, C, B) counts: the exponential of the pooled histogram's entropy, less one."""
    p = counts.sum(axis=0) / np.maximum(counts.sum(axis=(0, 2)), 1)[:, None]
    entropy = -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=-1)
    return np.maximum(np.exp(entropy) - 1.0, 1.0)


def residual_noise(observed: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Divergence (C,) expected between pooled counts if the residuals of the units had mean zero.

    A unit weighs by its samples, as it does in the pooled counts; one without samples on both sides tells nothing.

    Args:
      observed: (U, C, B) counts of the real units.
      simulated: (U, C, B) counts of the same units, simulated.
    """
    both = (observed.sum(axis=-1) > 0) & (simulated.sum(axis=-1) > 0)
    units = both.sum(axis=0)[:, None]
    real, real_moved = _pooled(np.where(both[..., None], observed, 0.0))
    model, model_moved = _pooled(np.where(both[..., None], simulated, 0.0))
    variance = np.sum((real_moved - model_moved) ** 2, axis=0) * units / np.maximum(units - 1, 1)
    middle = 0.5 * (real + model)
    return np.sum(variance / np.where(middle > 0, 8.0 * middle, np.inf), axis=-1)


def _pooled(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares (C, B) of (U, C, B) counts together, and how far (U, C, B) each unit moves them."""
    total = np.maximum(counts.sum(axis=(0, 2)), 1)[:, None]
    shares = counts.sum(axis=0) / total
    return shares, (counts - counts.sum(axis=-1, keepdims=True) * shares) / total


def floors(observed: Observed, counts: np.ndarray, divergence: np.ndarray, usable: np.ndarray) -> Floors:
    """Noise and misfit at the particles that fit best; the two depend on each other, so a few rounds are taken.

    Args:
      observed: the real rollouts.
      counts: (M, U, C, B) of the simulations.
      divergence: (M, C) of the pooled counts.
      usable: (M,) bool, particles that did not diverge.
    """
    candidates = np.flatnonzero(usable)
    scale = np.maximum(np.median(divergence[candidates], axis=0), 1e-9)
    freedom = effective_bins(observed.counts)
    least = freedom / (8 * np.maximum(observed.counts.sum(axis=(0, 2)), 1))  # were all samples independent
    found = Floors(np.zeros_like(scale), freedom, scale)
    for _ in range(3):
        energy = observed.by_statistic(divergence[candidates] / found.total).sum(axis=-1)
        best = candidates[np.argsort(energy, kind="stable")[:BEST]]
        noise = np.maximum(np.mean([residual_noise(observed.counts, counts[b]) for b in best], axis=0), least)
        found = Floors(noise, freedom, divergence[best].min(axis=0))
    return found


def energy(observed: Observed, divergence: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(...) sum over statistics of the mean over channels of (..., C) divergence / (C,) floor."""
    return observed.by_statistic(divergence / floor).sum(axis=-1)


def calibrate(
    rng: np.random.Generator,
    observed: Observed,
    counts: np.ndarray,
    floor: np.ndarray,
    z: np.ndarray,
    log_base: np.ndarray,
    full: np.ndarray,
) -> float:
    """The largest alpha at which the posterior is as wide as its mean varies over resampled rollouts.

    Args:
      rng: draws the resamples.
      observed: the real rollouts.
      counts: (M, U, C, B) of the simulations.
      floor: (C,).
      z: (M, P) particles, in the space where spread is judged.
      log_base: (M,) log-weights at alpha = 0, -inf for particles that do not count.
      full: (M,) energies with all rollouts.
    """
    order = np.argsort(np.where(np.isfinite(log_base), full, np.inf), kind="stable")[: np.isfinite(log_base).sum()]
    few = min(len(order), MOST_PARTICLES)  # the best alone would be narrower than the posterior
    order = order[np.linspace(0, len(order) - 1, few).round().astype(int)]
    counts, z, log_base, full = counts[order], z[order], log_base[order], full[order]
    units = len(observed.counts)
    resampled = rng.multinomial(units, np.full(units, 1 / units), size=RESAMPLES)
    energies = energy(observed, resampled_divergences(observed.counts, counts, resampled), floor).T
    accepted = 0.0
    for alpha in np.geomspace(1e-4, LARGEST_ALPHA, 40):
        if _relative_movement(alpha, energies, full, z, log_base) > 1.0:
            break
        accepted = float(alpha)
    return accepted


def _relative_movement(
    alpha: float, energies: np.ndarray, full: np.ndarray, z: np.ndarray, log_base: np.ndarray
) -> float:
    """Mean squared movement of the posterior mean over its variance, of the parameter where that is largest."""
    mean, variance = mean_and_variance(z, normalised(log_base - alpha * full))
    log_weights = log_base - alpha * energies
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    moved = (weights @ z) / weights.sum(axis=1, keepdims=True)
    return float(np.max(np.mean((moved - mean) ** 2, axis=0) / np.maximum(variance, 1e-12)))
