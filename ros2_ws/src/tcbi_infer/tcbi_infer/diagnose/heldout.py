"""Held-out scores of fitted models: each kind of motion is predicted from a fit to all the others.

The fit without a fold is one Gauss-Newton step from the fit to all folds, taken from the normal equations of the other
folds; its prediction of the fold is simulated, not linearised.
"""

import dataclasses

import numpy as np
from scipy.special import stdtrit

from tcbi_infer.diagnose.fit import Fit, Nuisance, bounded_step, to_physical
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.engine import simulate

DISCREPANT = 1.5  # times the noise floor: a model that leaves this much lacks something, if only a little
WIDEST = 6.0  # so much further off were parameters of emulated robots then, at the 90 % point (docs/diagnosis.md)


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """A model's predictions of motions that it was not fitted to.

    Attributes:
      score: (F,) log score of each fold in nats.
      residual: (open sets, T, C), each set predicted without its own fold.
      unit: (F, P) parameters without each fold.
    """

    score: np.ndarray
    residual: np.ndarray
    unit: np.ndarray


def fold_indices(problem: Problem, sets: np.ndarray) -> list[np.ndarray]:
    """Positions in `sets` of each kind of motion."""
    kinds = problem.kind[sets]
    return [np.nonzero(kinds == k)[0] for k in dict.fromkeys(kinds)]


def held_out(problem: Problem, fit: Fit, nuisance: Nuisance, sets: np.ndarray, timestep: float) -> HeldOut:
    """Predicts each fold from a fit to the others."""
    folds = fold_indices(problem, sets)
    count = len(fit.unit)
    units, deltas = np.empty((len(folds), count)), np.empty((len(folds), len(fit.nuisance)))
    for f, fold in enumerate(folds):
        train = np.setdiff1d(np.arange(len(sets)), fold)
        step = bounded_step(fit.normal[train].sum(axis=0), fit.slope[train].sum(axis=0), fit.unit, fit.nuisance)
        units[f] = np.clip(fit.unit + np.clip(step[:count], -0.25, 0.25), 0.0, 1.0)
        deltas[f] = fit.nuisance + step[count:]
    residual = _predict_folds(problem, fit, nuisance, sets, folds, units, deltas, timestep)
    score = np.empty(len(folds))
    for f, fold in enumerate(folds):
        train = np.setdiff1d(np.arange(len(sets)), fold)
        full = np.zeros_like(problem.observed)
        full[sets] = fit.residual
        scale = problem.scales(full, sets[train]) if len(train) else fit.scale
        score[f] = -problem.loss(residual[fold], scale, sets[fold]).sum()
    return HeldOut(score, residual, units)


def _predict_folds(
    problem: Problem,
    fit: Fit,
    nuisance: Nuisance,
    sets: np.ndarray,
    folds: list[np.ndarray],
    units: np.ndarray,
    deltas: np.ndarray,
    timestep: float,
) -> np.ndarray:
    replay, owner = problem.replay, np.empty(len(sets), int)
    for f, fold in enumerate(folds):
        owner[fold] = f
    rollouts = simulate(
        fit.model,
        to_physical(fit.model, units[owner]),
        [replay.scenarios[s] for s in sets],
        commands=[replay.commands[s] for s in sets],
        pairing="zip",
        timestep=timestep,
        rate=replay.layout.rate,
    )
    predicted = replay.layout.extract(rollouts)[:, 0, -len(replay.time) :]
    predicted[rollouts.diverged[:, 0]] = np.nan
    shift = np.einsum("stcq,sq->stc", nuisance.effect[sets], deltas[owner])
    return problem.residual(predicted + shift, sets)


def shared_error(residual: np.ndarray) -> float:
    """How many channels err alike: one wrong slope of the trunk is in all joints, and is not 18 pieces of evidence.

    Args:
      residual: (S, T, C), zero where nothing was measured.
    """
    flat = residual.reshape(-1, residual.shape[-1])
    used = flat.std(axis=0) > 0
    if used.sum() < 2:
        return 1.0
    values = np.linalg.eigvalsh(np.corrcoef(flat[:, used].T))
    return float((values**2).sum() / values.sum())


def widening(misfit: float) -> float:
    """By how much a model that leaves more than noise is less sure of its parameters than its own motions say.

    Args:
      misfit: error over the noise floor on unseen motions.
    """
    seen = np.clip((misfit - 1.0) / (DISCREPANT - 1.0), 0.0, 1.0)
    return float(max(misfit, 1.0 + (WIDEST - 1.0) * seen))


def intervals(
    fit: Fit, held: HeldOut, drift: np.ndarray, misfit: float, level: float = 0.9
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interval of each parameter in unit space.

    The spread is the larger of two: the curvature of the loss, in which samples count by their autocorrelation and
    channels by their correlation, and the jackknife over kinds of motion, which also sees what the model gets wrong
    differently from motion to motion. It is widened by `widening`: a discrepancy that all motions share shifts
    parameters in a way that no spread between motions shows. To it comes what the simulation's own time step leaves.

    Args:
      fit: the fit.
      held: its held-out predictions.
      drift: (P,) how far the optimum may still move as the time step goes to zero.
      misfit: error over the noise floor on unseen motions.
      level: of the interval.

    Returns:
      low, high: (P,); covariance: (P, P).
    """
    count, folds = len(fit.unit), len(held.unit)
    prior = np.r_[np.full(count, 3.0), np.ones(len(fit.nuisance))]
    normal = fit.normal.sum(axis=0) / shared_error(fit.residual)
    curvature = np.linalg.inv(normal + np.diag(prior))[:count, :count]
    if folds > 1:
        apart = held.unit - held.unit.mean(axis=0)
        jackknife = (folds - 1) / folds * apart.T @ apart
    else:
        jackknife = np.zeros_like(curvature)
    grow = np.sqrt(np.maximum(1.0, np.diag(jackknife) / np.diag(curvature)))
    grow *= widening(misfit)
    covariance = curvature * np.outer(grow, grow) + np.diag(drift**2 / 3.0)
    quantile = stdtrit(max(folds - 1, 2), 0.5 + level / 2)
    half = quantile * np.sqrt(np.diag(covariance))
    return np.clip(fit.unit - half, 0, 1), np.clip(fit.unit + half, 0, 1), covariance
