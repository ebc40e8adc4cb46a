"""Held-out scores of fitted models: each kind of motion is predicted from a fit to all the others.

The fit without a fold is one Gauss-Newton step from the fit to all folds, taken from the normal equations of the other
folds; its prediction of the fold is simulated, not linearised.
"""

import dataclasses

import numpy as np
from scipy.special import ndtri, stdtrit

from tcbi_infer.diagnose.fit import Fit
from tcbi_infer.diagnose.least_squares import bounded_step, prior_precision
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.engine import simulate


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """A model's predictions of motions that it was not fitted to.

    Attributes:
      score: (F,) log score of each fold in nats.
      residual: (open sets, T, C), each set predicted without its own fold.
      unit: (F, P) parameters without each fold.
      predicted: (open sets, T, C) the predictions themselves, also where nothing counts; NaN where they diverged.
    """

    score: np.ndarray
    residual: np.ndarray
    unit: np.ndarray
    predicted: np.ndarray


def fold_indices(problem: Problem, sets: np.ndarray) -> list[np.ndarray]:
    """Positions in `sets` of each kind of motion."""
    kinds = problem.kind[sets]
    return [np.nonzero(kinds == k)[0] for k in dict.fromkeys(kinds)]


def held_out(problem: Problem, fit: Fit, sets: np.ndarray, timestep: float) -> HeldOut:
    """Predicts each fold from a fit to the others; a single fold from the fit to itself."""
    folds = fold_indices(problem, sets)
    count = len(fit.unit)
    units, deltas = np.empty((len(folds), count)), np.empty((len(folds), len(fit.nuisance)))
    for f, fold in enumerate(folds):
        train = np.setdiff1d(np.arange(len(sets)), fold)
        if not len(train):
            units[f], deltas[f] = fit.unit, fit.nuisance
            continue
        step = bounded_step(fit.normal[train].sum(axis=0), fit.slope[train].sum(axis=0), fit.unit, fit.nuisance)
        units[f] = np.clip(fit.unit + np.clip(step[:count], -0.25, 0.25), 0.0, 1.0)
        deltas[f] = fit.nuisance + step[count:]
    predicted = _predict_folds(problem, fit, sets, folds, units, deltas, timestep)
    residual = problem.residual(predicted, sets)
    score = np.empty(len(folds))
    for f, fold in enumerate(folds):
        train = np.setdiff1d(np.arange(len(sets)), fold)
        full = np.zeros_like(problem.observed)
        full[sets] = fit.residual
        scale = problem.scales(full, sets[train]) if len(train) else fit.scale
        score[f] = -problem.loss(residual[fold], scale, sets[fold]).sum()
    return HeldOut(score, residual, units, predicted)


def _predict_folds(
    problem: Problem,
    fit: Fit,
    sets: np.ndarray,
    folds: list[np.ndarray],
    units: np.ndarray,
    deltas: np.ndarray,
    timestep: float,
) -> np.ndarray:
    """(open sets, T, C), nuisances included."""
    replay, owner = problem.replay, np.empty(len(sets), int)
    for f, fold in enumerate(folds):
        owner[fold] = f
    rollouts = simulate(
        fit.model,
        fit.model.from_unit(units[owner]),
        [replay.scenarios[s] for s in sets],
        commands=[replay.commands[s] for s in sets],
        pairing="zip",
        timestep=timestep,
        rate=replay.layout.rate,
    )
    predicted = replay.layout.extract(rollouts)[:, 0, -len(replay.time) :]
    predicted[rollouts.diverged[:, 0]] = np.nan
    shift = np.einsum("stcq,sq->stc", fit.scatter.effect[sets], deltas[owner])
    return predicted + shift


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
    return float((values**2).sum()) / float(values.sum())


def imitated(square: float, misfit: float) -> float:
    """The squared length of a discrepancy that may hide behind the parameters, for one that is left of `square`.

    Args:
      square: weighted sum of a fit's squared residuals, noise included.
      misfit: error over the noise floor on unseen motions.
    """
    return square * (1.0 - 1.0 / max(misfit, 1.0) ** 2)


def discrepancy_shift(fit: Fit, misfit: float) -> tuple[np.ndarray, np.ndarray]:
    """How far a discrepancy as large as what the model leaves unexplained could have shifted the parameters.

    What remains visible is what the parameters could not imitate. A part of the same size that they could imitate
    would be invisible, and shift each by at most its length times the inverse curvature's root (Cauchy and Schwarz).

    Args:
      fit: the fit.
      misfit: error over the noise floor on unseen motions.

    Returns:
      (P,) shift; (P, P) inverse curvature in unit space, of which it is a multiple of the diagonal's roots.
    """
    count = len(fit.unit)
    prior = np.diag(prior_precision(count, len(fit.nuisance)))
    inverse = np.linalg.inv(fit.normal.sum(axis=0) + prior)[:count, :count]
    return np.sqrt(imitated(float(fit.square.sum()), misfit) * np.diag(inverse)), inverse


def intervals(
    fit: Fit, held: HeldOut, drift: np.ndarray, misfit: float, level: float = 0.9
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interval of each parameter in unit space.

    Three things add up in quadrature. The spread: the larger of the curvature of the loss, in which samples count by
    their autocorrelation and channels by their correlation, and of the jackknife over kinds of motion. What a
    discrepancy that all motions share may have shifted (`discrepancy_shift`), which no spread between motions shows.
    And what the simulation's own time step leaves.

    Args:
      fit: the fit.
      held: its held-out predictions.
      drift: (P,) how far the optimum may still move as the time step goes to zero.
      misfit: error over the noise floor on unseen motions.
      level: of the interval.

    Returns:
      low, high: (P,); covariance: (P, P) of a normal distribution with these intervals.
    """
    folds = len(held.unit)
    shift, inverse = discrepancy_shift(fit, misfit)
    variance = shared_error(fit.residual) * np.diag(inverse)
    if folds > 1:
        apart = held.unit - held.unit.mean(axis=0)
        variance = np.maximum(variance, (folds - 1) / folds * (apart**2).sum(axis=0))
    quantile = stdtrit(max(folds - 1, 1), 0.5 + level / 2)
    half = np.sqrt(quantile**2 * (variance + drift**2 / 3.0) + shift**2)
    grow = half / (ndtri(0.5 + level / 2) * np.sqrt(np.diag(inverse)))
    return np.clip(fit.unit - half, 0, 1), np.clip(fit.unit + half, 0, 1), inverse * np.outer(grow, grow)
