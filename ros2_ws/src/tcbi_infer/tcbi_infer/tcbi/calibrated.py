"""Calibrated TCBI, the default: population Monte Carlo with honest weights.

Differs from `paper` in that

- a particle's weight is prior x pseudo-likelihood / proposal, the proposal being the mixture of all that were ever used
  (deterministic-mixture weights), so every simulation ever run counts and iterating does not narrow the posterior;
- alpha is not a constant: it rises as the effective sample size allows, up to the value that the data support
  (`calibration`);
- motions that are compared in time are weighed as regression on the nearest particles foresees them (`expansion`), and
  as shorter time steps would have them (`finer`);
- particles live in probit space, so the flat prior's bounds are kept without reflection (`proposal`).

    state = init(dimensions, settings)
    while not finished(state, settings):
        state, info = step(rng, state, simulate, observed, settings)
        state, _ = finely(rng, state, simulate_with_short_steps, observed, settings)
    unit, log_weights = posterior(state)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tcbi_contract.errors import describe
from tcbi_infer.errors import SettingError
from tcbi_infer.tcbi import calibration, finer
from tcbi_infer.tcbi.emulator import expected_draws
from tcbi_infer.tcbi.expansion import Expansion, expansion, nearest
from tcbi_infer.tcbi.features import Features, Observed, weighable
from tcbi_infer.tcbi.in_time import no_differences
from tcbi_infer.tcbi.proposal import (
    Proposal,
    draw,
    from_probit,
    log_mixture,
    log_prior,
    prior_proposal,
    proposal,
)
from tcbi_infer.tcbi.weights import effective_sample_size, mean_and_variance, normalised, temper

EXPECTED = 1000  # points where the emulator expects the posterior
WIDEN = 1.5  # a proposal should be wider than its target: by so much less the energies count there


class CalibratedSettings(NamedTuple):
    """Budget and shape of the search."""

    particles: int = 50  # simulated in each generation
    generations: int = 6
    prior_share: float = 0.1  # of each later generation, drawn from the prior
    least_ess: float = 0.4  # of `particles`: alpha rises no further than this allows
    alpha: float = calibration.LARGEST_ALPHA  # at most; a smaller one widens the posterior


class CalibratedState(NamedTuple):
    """Every simulation ever run, and its weight now."""

    generation: int
    z: np.ndarray  # (M, P) probit space
    features: Features  # of M particles
    proposals: tuple[Proposal, ...]  # one a generation
    energy: np.ndarray  # (M,) above the least, inf where diverged
    floor: np.ndarray  # (C + K,) that divergences are divided by
    log_weights: np.ndarray  # (M,)
    alpha: float
    alpha_supported: float  # by the data, as far as the simulations so far can tell
    converged: bool
    correction: finer.Correction  # that the features were given


class CalibratedInfo(NamedTuple):
    """What happened in a generation."""

    divergence: np.ndarray  # (statistics,) weighted mean over particles
    ess: float
    alpha: float
    alpha_supported: float
    floor_noise: np.ndarray  # (statistics,) mean over channels
    floor_misfit: np.ndarray  # (statistics,)
    misfit: np.ndarray  # (C + K,) over the channel's noise, or its statistic's mean of that where it is more
    best: np.ndarray  # (n, P) the particles that fit best, in the cube where the prior is uniform


def init(dimensions: int) -> CalibratedState:
    """Nothing simulated yet."""
    none = np.zeros(0)
    features = Features(
        np.zeros((0, 1, 1, 1), np.float32), np.zeros((0, 1)), none, np.zeros(0, bool), no_differences(0)
    )
    return CalibratedState(0, np.zeros((0, dimensions)), features, (), none, none, none, 0.0, 0.0, False, finer.NONE)


def step(
    rng: np.random.Generator,
    state: CalibratedState,
    simulate: Callable[[np.ndarray], Features],
    observed: Observed,
    settings: CalibratedSettings,
) -> tuple[CalibratedState, CalibratedInfo]:
    """Propose, simulate, weigh everything anew.

    Args:
      rng: the randomness of this generation.
      state: after the previous generation.
      simulate: (N, P) in [0, 1] -> features.
      observed: the real rollouts.
      settings: budget.

    Raises:
      SettingError: alpha is out of its range.
      InferError: every simulation diverged, or none has a finite divergence.
    """
    if not 0 < settings.alpha <= calibration.LARGEST_ALPHA:
        raise SettingError(describe("alpha", settings.alpha, f"above 0, at most {calibration.LARGEST_ALPHA}"))
    if state.generation == 0:
        drawn_from = prior_proposal(settings.particles, state.z.shape[1])
    else:
        expected = _expected(rng, state, observed)
        weights = normalised(state.log_weights)
        drawn_from = proposal(settings.particles, state.z, weights, expected, settings.prior_share)
    fresh = draw(rng, drawn_from)
    simulated = _corrected(observed, simulate(from_probit(fresh)), state.correction)
    features = simulated if state.generation == 0 else state.features.join(simulated)
    usable = weighable(features, observed.channels)
    features = features._replace(divergence=np.where(usable[:, None], features.divergence, 0.0), valid=usable)
    z, proposals = np.concatenate([state.z, fresh]), (*state.proposals, drawn_from)
    return _weigh(rng, state, z, features, proposals, observed, settings)


def finely(
    rng: np.random.Generator,
    state: CalibratedState,
    simulate: Callable[[np.ndarray], Features],
    observed: Observed,
    settings: CalibratedSettings,
) -> tuple[CalibratedState, CalibratedInfo | None]:
    """Allow for what shorter time steps do, once: before the last generation, or where the search would have ended.

    The generation is weighed anew then; else it stays as it is, and nothing happened.

    Args:
      rng: the randomness of the weights.
      state: after a generation.
      simulate: as of `step`, with shorter time steps.
      observed: the real rollouts.
      settings: budget.
    """
    left = settings.generations - state.generation
    if state.correction.particles or not (left == 1 or (left > 1 and state.converged)):
        return state, None
    moves = _expansion(observed, state.features, state.floor, state.energy, state.z)
    if moves is None:
        return state, None
    near = np.argsort(state.energy, kind="stable")[: finer.PARTICLES]
    short = simulate(from_probit(state.z[near]))
    usable = short.valid & np.isfinite(short.divergence).all(axis=1) & np.isfinite(state.energy[near])
    if usable.sum() < finer.LEAST:
        return state, None
    used, floor = near[usable], state.floor[observed.histograms :]
    long = state.features.differences.only(used)
    found = finer.correction(observed.in_time, floor, moves, state.z[used], long, short.differences.only(usable))
    before, features = state._replace(correction=found), _corrected(observed, state.features, found)
    after, info = _weigh(rng, before, state.z, features, state.proposals, observed, settings)
    return after._replace(generation=state.generation, converged=False), info


def _corrected(observed: Observed, features: Features, by: finer.Correction) -> Features:
    if not by.particles:
        return features
    moved = finer.corrected(features.differences, by)
    in_time = np.where(features.valid[:, None], observed.in_time.divergences(moved), 0.0)
    divergence = np.concatenate([features.divergence[:, : observed.histograms], in_time], axis=1)
    return features._replace(divergence=divergence, differences=moved)


def _expected(rng: np.random.Generator, state: CalibratedState, observed: Observed) -> np.ndarray | None:
    """(n, P) draws from where the posterior is expected, None while nothing can be expected."""
    alpha = state.alpha_supported / WIDEN
    moves = _expansion(observed, state.features, state.floor, state.energy, state.z)
    if moves is None:
        return expected_draws(rng, state.z, state.energy, alpha, EXPECTED)
    rest = calibration.energy(observed, state.features.divergence, state.floor, in_time=False)
    rest = np.where(np.isfinite(state.energy), rest - rest[np.isfinite(state.energy)].min(), np.inf)
    return expected_draws(rng, state.z, rest, alpha, EXPECTED, moves)


def _weigh(
    rng: np.random.Generator,
    before: CalibratedState,
    z: np.ndarray,
    features: Features,
    proposals: tuple[Proposal, ...],
    observed: Observed,
    settings: CalibratedSettings,
) -> tuple[CalibratedState, CalibratedInfo]:
    log_base = np.where(features.valid, log_prior(z) - log_mixture(proposals, z), -np.inf)
    floors, energy = _judged(observed, features)
    seen, doubt = _smoothed(observed, features, floors.total, energy, z)
    doubt[observed.histograms :] += before.correction.doubt
    floors, energy = _judged(observed, seen, doubt)
    supported = calibration.calibrate(rng, observed, seen, floors.total, z, log_base, energy)
    supported = min(supported, settings.alpha)
    alpha = temper(energy, log_base, supported, settings.least_ess * settings.particles)
    log_weights = np.where(features.valid, log_base - alpha * np.where(features.valid, energy, 0.0), -np.inf)
    weights = normalised(log_weights)
    noise = observed.by_statistic(floors.noise)
    info = CalibratedInfo(
        divergence=weights @ observed.by_statistic(seen.divergence),
        ess=effective_sample_size(weights),
        alpha=alpha,
        alpha_supported=supported,
        floor_noise=noise,
        floor_misfit=observed.by_statistic(floors.misfit),
        misfit=floors.misfit / np.maximum(np.maximum(floors.noise, noise[observed.statistic]), calibration.LEAST),
        best=from_probit(z[np.argsort(energy, kind="stable")[: calibration.BEST]]),
    )
    converged = before.generation >= 2 and alpha >= 0.99 * supported and _steady(before, z, weights)
    state = CalibratedState(
        before.generation + 1, z, features, proposals, energy, floors.total, log_weights, alpha, supported,
        bool(converged), before.correction,
    )  # fmt: skip
    return state, info


def _judged(
    observed: Observed, features: Features, doubt: np.ndarray | float = 0.0
) -> tuple[calibration.Floors, np.ndarray]:
    """The floors, and the (M,) energies above the least, inf where diverged."""
    floors = calibration.floors(observed, features, doubt)
    energy = calibration.energy(observed, features.divergence, floors.total)
    return floors, np.where(features.valid, energy - energy[features.valid].min(), np.inf)


def _smoothed(
    observed: Observed, features: Features, floor: np.ndarray, energy: np.ndarray, z: np.ndarray
) -> tuple[Features, np.ndarray]:
    """The same with motions that are foreseen by regression in place of each one's own, and the doubt about them."""
    moves, doubt = _expansion(observed, features, floor, energy, z), np.zeros(len(floor))
    if moves is None:
        return features, doubt
    in_time, histograms = observed.in_time, observed.histograms
    doubt[histograms:] = in_time.doubt(floor[histograms:], moves)
    smooth = in_time.foreseen(features.differences, floor[histograms:], moves, z)
    foreseen = np.where(features.valid[:, None], in_time.divergences(smooth), 0.0)
    divergence = np.concatenate([features.divergence[:, :histograms], foreseen], axis=1)
    return features._replace(divergence=divergence, differences=smooth), doubt


def _expansion(
    observed: Observed, features: Features, floor: np.ndarray, energy: np.ndarray, z: np.ndarray
) -> Expansion | None:
    """Of the motions; None where nothing is compared in time, or the particles are too few."""
    near = nearest(energy, z.shape[1]) if observed.in_time.variance.size else None
    if near is None:
        return None
    motion = observed.in_time.motion(features.differences.only(near), floor[observed.histograms :])
    return expansion(z[near], motion)


def _steady(before: CalibratedState, z: np.ndarray, weights: np.ndarray) -> bool:
    """Whether the posterior mean moved by less than a quarter of its standard deviation."""
    mean, variance = mean_and_variance(z, weights)
    last, _ = mean_and_variance(before.z, normalised(before.log_weights))
    return bool(np.all(np.abs(mean - last) <= 0.25 * np.sqrt(variance)))


def finished(state: CalibratedState, settings: CalibratedSettings) -> bool:
    """Enough, or the budget is spent."""
    return state.converged or state.generation >= settings.generations


def distrusted(state: CalibratedState, ratio: float) -> np.ndarray:
    """(M,) log-weights with the data's say divided by how many times too much remains of a divergence.

    A model that cannot reproduce one statistic cannot be relied on for where the others put its parameters.
    """
    known = np.isfinite(state.log_weights)
    energy = np.where(known, state.energy, 0.0)
    return np.where(known, state.log_weights + state.alpha * (1 - 1 / max(ratio, 1.0)) * energy, -np.inf)


def posterior(state: CalibratedState) -> tuple[np.ndarray, np.ndarray]:
    """(M, P) particles in [0, 1] and (M,) log-weights."""
    return from_probit(state.z), state.log_weights
