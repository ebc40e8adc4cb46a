"""How sharply divergences may weigh particles: their noise floors, and alpha.

The pseudo-likelihood of a particle is exp(-alpha E), where the energy E sums over statistics the mean over channels of
divergence / floor. Four things decide:

- *Noise.* Part of a channel's divergence remains with the right parameters, because rollouts are few. How the residuals
  differ between rollouts says how much (`pooled`). It is spread over some degrees of freedom, for `js` the bins in use;
  a right likelihood falls by 1/2 when a divergence rises by one degree's share, hence `LARGEST_ALPHA` = 1/2.
- *Misfit.* What the best particles cannot remove beyond the noise is systematic and shared by all rollouts, so nothing
  averages it: it counts in full. A model that does not fit thus widens its own posterior.
- *In time.* Of what is compared in time (`in_time`) all that the best particles leave is noise, spread over as many
  degrees of freedom as it has independent means; what regression misses is added, and what short steps leave open.
- *Rollouts.* What would other rollouts have said? The real ones are resampled with replacement (and with them the
  simulations of the same scenarios: they are paired). The posterior mean moves from resample to resample; alpha is the
  largest at which it moves no more than the posterior is wide (general posterior calibration, Syring and Martin 2019).
"""

from typing import NamedTuple

import numpy as np

from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.features import Features, Observed, not_finite, resampled_divergences
from tcbi_infer.tcbi.weights import mean_and_variance, normalised

LARGEST_ALPHA = 0.5
RESAMPLES = 40
LEAST = 1e-9  # divergence of a floor
BEST = 5  # particles that show what divergence remains


class Floors(NamedTuple):
    """Divergence per channel below which differences mean nothing."""

    noise: np.ndarray  # (C + K,) expected of a right model, from how residuals vary between rollouts
    freedom: np.ndarray  # (C + K,) degrees of freedom that the noise is spread over
    misfit: np.ndarray  # (C + K,) what the best particles cannot remove
    doubt: np.ndarray  # (C + K,) about divergences that are foreseen by regression, or corrected to short steps

    @property
    def total(self) -> np.ndarray:
        """(C + K,) what divergences are divided by, positive."""
        floor = self.noise / self.freedom + np.maximum(self.misfit - self.noise, 0.0) + self.doubt
        return np.maximum(floor, LEAST)


def floors(observed: Observed, simulated: Features, doubt: np.ndarray | float = 0.0) -> Floors:
    """Noise and misfit at the particles that fit best; the two depend on each other, so a few rounds are taken.

    Args:
      observed: the real rollouts.
      simulated: of M particles.
      doubt: (C + K,) about their divergences.

    Raises:
      InferError: the divergence of the rollouts from ones like them is not finite.
    """
    candidates, divergence = np.flatnonzero(simulated.valid), simulated.divergence
    scale = np.maximum(np.median(divergence[candidates], axis=0), LEAST)
    doubted = np.broadcast_to(doubt, scale.shape)
    found = Floors(np.zeros_like(scale), np.ones_like(scale), scale, doubted)
    for _ in range(3):
        energy = observed.by_statistic(divergence[candidates] / found.total).sum(axis=-1)
        best = candidates[np.argsort(energy, kind="stable")[:BEST]]
        each = [observed.measure.noise(observed.counts, simulated.counts[b]) for b in best]
        in_time = [observed.in_time.noise(simulated.differences, b) for b in best]
        noise, freedom = np.concatenate([np.mean(each, axis=0), np.mean(in_time, axis=0)], axis=-1)
        if not np.isfinite(noise).all():
            raise InferError(not_finite(observed.channels, ~np.isfinite(noise)))
        found = Floors(noise, freedom, divergence[best].min(axis=0), doubted)
    return found


def energy(observed: Observed, divergence: np.ndarray, floor: np.ndarray, in_time: bool = True) -> np.ndarray:
    """(...) sum over statistics of the mean over channels of (..., C + K) divergence / (C + K,) floor.

    Without those that are compared in time if `in_time` is false.
    """
    terms = observed.by_statistic(divergence / floor)
    return terms[..., : terms.shape[-1] - (0 if in_time else len(observed.in_time.variance))].sum(axis=-1)


def calibrate(
    rng: np.random.Generator,
    observed: Observed,
    simulated: Features,
    floor: np.ndarray,
    z: np.ndarray,
    log_base: np.ndarray,
    full: np.ndarray,
) -> float:
    """The largest alpha at which the posterior is as wide as its mean varies over resampled rollouts.

    Args:
      rng: draws the resamples.
      observed: the real rollouts.
      simulated: of M particles.
      floor: (C + K,).
      z: (M, P) particles, in the space where spread is judged.
      log_base: (M,) log-weights at alpha = 0, -inf for particles that do not count.
      full: (M,) energies with all rollouts.

    Raises:
      InferError: of some resample no particle has a finite divergence.
    """
    order = np.argsort(np.where(np.isfinite(log_base), full, np.inf), kind="stable")[: np.isfinite(log_base).sum()]
    few = min(len(order), observed.measure.particles)  # evenly: the best alone would be narrower than the posterior
    order = order[np.linspace(0, len(order) - 1, few).round().astype(int)]
    counts, z, log_base, full = simulated.counts[order], z[order], log_base[order], full[order]
    differences = simulated.differences.only(order)
    units = len(observed.counts)
    resampled = rng.multinomial(units, np.full(units, 1 / units), size=RESAMPLES)
    divergence = resampled_divergences(observed, counts, resampled)
    divergence = np.concatenate([divergence, observed.in_time.divergences(differences, resampled)], axis=-1)
    energies = energy(observed, divergence, floor).T
    hopeless = ~np.isfinite(energies).any(axis=1)
    if hopeless.any():
        raise InferError(not_finite(observed.channels, ~np.isfinite(divergence[:, hopeless]).all(axis=(0, 1))))
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
