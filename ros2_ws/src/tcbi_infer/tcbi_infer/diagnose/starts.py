"""Where the fit of a candidate starts: the base fit may have bent its parameters to make up for what it lacks.

A base model without damping answers as late as the robot if its servos are soft, and then carries too little mass. So
starts lie along the directions in which the data tell the base parameters apart worst, each with the effect at several
sizes. All of them are one batch of simulations.
"""

from collections.abc import Sequence

import numpy as np

from tcbi_infer.diagnose.fit import RACE, RACERS, Fit, Fitter
from tcbi_infer.diagnose.least_squares import gram
from tcbi_infer.diagnose.screen import Screen, Targets
from tcbi_infer.diagnose.valley import scaled_together
from tcbi_sim.parameter import Parameter

FACTORS = (0.5, 0.7, 1.4, 2.0, 2.8)  # of all forces and masses together
REACH = (-0.45, 0.45)  # of the natural logarithm of a positive parameter, or of another's range
EFFECT_SIZES = (0.08, 0.22, 0.5)  # of an effect's range
DIRECTIONS = 2  # of an effect, the best by screening
RUNNERS = 6  # starts whose base parameters settle before the best are chosen
SETTLING = 2  # steps of them
FAR = 0.12  # of a range
LONGEST = 0.7  # of one such step, in the coordinates of REACH
LEAST_EIGENVALUE = 1e-9


def start_points(screen: Screen, targets: Targets, use: int, base: Fit, fitter: Fitter) -> np.ndarray:
    """(n, P + q) unit vectors from which to fit a use, the best of many around the base fit and far from it.

    Args:
      screen: the screening of all uses.
      targets: of the data.
      use: which.
      base: the base model's fit.
      fitter: of the use.
    """
    near = screen.start(targets, use, base, DIRECTIONS)
    effects = screen.sized(targets, use, EFFECT_SIZES, DIRECTIONS)
    bases = np.concatenate([base.unit[None], weakly_known(base)])
    far = [np.concatenate([b, e]) for e in effects for b in bases]
    return _settled(fitter.on_few_sets(), fitter.few_positions(), np.concatenate([near, np.array(far)]), base)


def _settled(few: Fitter, positions: np.ndarray, starts: np.ndarray, base: Fit) -> np.ndarray:
    """The best starts after some steps of their base parameters with the base fit's slopes.

    Slopes against the logarithm of a positive parameter hardly change along the directions that the data tell worst.
    """
    count = len(base.unit)
    rates = np.array([_rate(p, v) for p, v in zip(base.model.parameters, base.parameters, strict=True)])
    design = np.concatenate([base.jacobian[positions] * rates, few.scatter.effect[few.sets]], axis=-1)
    best_loss, best = np.zeros(0), np.zeros((0, starts.shape[1]))
    zero = np.zeros(design.shape[-1] - count)
    for _ in range(SETTLING):
        predicted = few.predict(starts)
        losses = np.array(few.start_losses(predicted, zero))
        best_loss, best = np.r_[best_loss, losses], np.concatenate([best, starts])
        order = np.argsort(losses)[:RUNNERS]
        moved = [_step(few, design, predicted[i], starts[i], base, count) for i in order if np.isfinite(losses[i])]
        if not moved:
            break
        starts = np.array(moved)
    losses = np.array(few.start_losses(few.predict(starts), zero))
    best_loss, best = np.r_[best_loss, losses], np.concatenate([best, starts])
    return _raced(few, best[np.argsort(best_loss)])


def _raced(few: Fitter, starts: np.ndarray) -> np.ndarray:
    """The best start and the best that lies far from it, each fitted a little, the better one first."""
    chosen = [starts[0]]
    for start in starts[1:]:
        if len(chosen) < RACERS and min(np.max(np.abs(start - c)) for c in chosen) > FAR:
            chosen.append(start)
    fits = [few.run(start[None], radii=RACE, valleys=False) for start in chosen]
    return np.array([f.unit for f in sorted(fits, key=lambda f: f.total)])


def _step(
    few: Fitter, design: np.ndarray, predicted: np.ndarray, start: np.ndarray, base: Fit, count: int
) -> np.ndarray:
    """(P + q) a start whose base parameters made one step to fit better; the effect keeps its size."""
    residual = few.residual(predicted, np.zeros(design.shape[-1] - count))
    weights = few.precision(residual, few.scales(residual), np.zeros_like(residual))
    normal, slope = gram(design, residual, weights)
    prior = np.r_[np.full(count, 1e-2), np.ones(design.shape[-1] - count)]
    step = np.linalg.solve(normal.sum(axis=0) + np.diag(prior), slope.sum(axis=0))[:count]
    return np.r_[_moved(base.model.parameters, start[:count], np.clip(step, -LONGEST, LONGEST)), start[count:]]


def weakly_known(base: Fit) -> np.ndarray:
    """(n, P) unit vectors far enough from a base fit to leave a wrong optimum.

    All forces and masses scaled together, and the base parameters' least certain direction.
    """
    parameters = base.model.parameters
    rate = np.array([_rate(p, v) for p, v in zip(parameters, base.parameters, strict=True)])
    count = len(rate)
    normal = base.normal.sum(axis=0)[:count, :count] * np.outer(rate, rate)
    weakest = np.linalg.eigh(normal + LEAST_EIGENVALUE * np.eye(count))[1][:, 0]
    weakest /= np.max(np.abs(weakest))
    points = [_moved(parameters, base.unit, reach * weakest) for reach in REACH]
    points += [scaled_together(base.model, base.unit, factor) for factor in FACTORS]
    return np.array(points)


def _rate(parameter: Parameter, value: float) -> float:
    """Change of the unit coordinate with the logarithm of a positive parameter; 1 for one that may be negative."""
    if parameter.low <= 0:
        return 1.0
    step = 1e-4
    return float((parameter.to_unit(value * (1 + step)) - parameter.to_unit(value)) / step)


def _moved(parameters: Sequence[Parameter], unit: np.ndarray, step: np.ndarray) -> np.ndarray:
    """(P,) unit vector after a step in the coordinates of `_rate`, within the bounds."""
    moved = []
    for p, u, s in zip(parameters, unit, step, strict=True):
        to = u + s if p.low <= 0 else float(p.to_unit(np.clip(float(p.from_unit(u)) * np.exp(s), p.low, p.high)))
        moved.append(np.clip(to, 0.02, 0.98))
    return np.array(moved)
