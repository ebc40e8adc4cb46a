"""Other valleys of the loss, where a fit may have ended in the wrong one."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from tcbi_infer.diagnose.fit import RACE, RACERS, Fit, Fitter, Trial
from tcbi_infer.diagnose.least_squares import bounded_step
from tcbi_infer.diagnose.slopes import Slopes
from tcbi_infer.diagnose.valley import at_level, is_mass, scaled_freely, shifted_freely

LEAPS = (-0.4, -0.2, 0.2, 0.4)  # of a range
WORTH = 0.05  # of the loss: a far point that is lower by less is not followed
FACTOR = 1.22  # of all forces, from one point of their valley to the next
SHIFT = 0.08  # of a range: the same of a size
POINTS = 6  # at most, each way
CROSSINGS = 2  # steps across, at each point
CLOSE = 0.05  # of a range: the radius of slopes there
STEEP = 1.3  # times the least loss: where the floor rises so far nothing is looked for beyond
DRIFTED = 0.03  # of a range, from coarse to fine steps: a size that moves less does not hang on the time step
LEVEL = 1.03  # times the loss here: no higher end on few sets is followed on all

Move = Callable[[np.ndarray], np.ndarray | None]  # (P,) place -> the next one, if within bounds


def leapt(fitter: Fitter, fit: Fit, count: int) -> Fit:
    """The fit, or a better one begun far off along one of the first `count` parameters.

    Whether a foot slips or sticks turns at some friction, so the loss has several valleys. They are narrow: a far point
    says little before it has been fitted a little.
    """
    far = [at_level(fit.unit, p, fit.unit[p] + leap) for p in range(count) for leap in LEAPS]
    starts = np.array([f for f in far if np.abs(f - fit.unit).max() > min(np.abs(LEAPS)) / 4])
    few = fitter.on_few_sets()
    order = np.argsort(few.start_losses(few.predict(starts), fit.nuisance))[:RACERS]
    raced = [few.run(starts[i][None], fit.nuisance, RACE, valleys=False) for i in order]
    best = min(raced, key=lambda f: f.total)
    here = few.run(fit.unit[None], fit.nuisance, ())
    if not best.total < (1.0 - WORTH) * here.total:
        return fit
    other = fitter.run(best.unit[None], fit.nuisance)
    return other if other.total < fit.total else fit


def rescaled(fitter: Fitter, fit: Fit) -> Fit:
    """The fit, or a better one with all forces and masses multiplied alike.

    A stiffer and heavier robot moves nearly as a lighter one does, so the loss has a long valley there, with steep
    walls: where an effect is new to a fit, its steps go down the nearest wall and not along.
    """
    factors = (FACTOR, 1.0 / FACTOR)
    return _followed(fitter, fit, [functools.partial(scaled_freely, fitter.model, factor) for factor in factors])


def resized(fitter: Fitter, fit: Fit, coarse: Fit, count: int) -> Fit:
    """The fit, or a better one with another size of its effect, whose parameters stand after the first `count`.

    Only where the direction is so soft that a fit with fine steps stays near where the coarse one began it: of a size
    that hangs on the time step, and of a mass, for motion tells little more than its sum with the model's own.
    """
    parameters, drift = fitter.model.parameters, np.abs(fit.unit - coarse.unit)
    sizes = [p for p in range(count, len(fit.unit)) if parameters[p].null is not None]
    soft = [p for p in sizes if drift[p] > DRIFTED or is_mass(parameters[p])]
    if not soft:
        return fit
    most = max(soft, key=lambda p: (is_mass(parameters[p]), drift[p]))  # a moment may move farther than its mass
    return _followed(fitter, fit, [functools.partial(shifted_freely, most, shift) for shift in (SHIFT, -SHIFT)])


def _followed(fitter: Fitter, fit: Fit, ways: Sequence[Move]) -> Fit:
    """The fit, or a better one along a valley: few sets are followed along its floor, the other parameters settled at
    each point, begun from the point before."""
    if not fit.total < np.inf:
        return fit
    few = fitter.on_few_sets(fitter.timestep)
    here = few.trials(fit.unit[None], fit.nuisance, fit.scale)[0]
    ends = [end for way in ways for end in _along(few, here, fit.scale, way)]
    likely = sorted((e for e in ends if e.total < LEVEL * here.total), key=lambda e: e.total)[:RACERS]
    others = [fitter.run(end.unit[None], fit.nuisance, RACE, valleys=False) for end in likely]
    return min([fit, *others], key=lambda f: f.total)


def _along(few: Fitter, here: Trial, scale: np.ndarray, way: Move) -> list[Trial]:
    """Places on the valley's floor, one after the other."""
    slopes, found, least = Slopes(few.predict_for_slopes), [], here.total
    for _ in range(POINTS):
        unit = way(here.unit)
        if unit is None:
            break
        here = _across(few, here, unit, scale, slopes)
        found.append(here)
        least = min(least, here.total)
        if not here.total < STEEP * least:
            break
    return found


def _across(few: Fitter, here: Trial, unit: np.ndarray, scale: np.ndarray, slopes: Slopes) -> Trial:
    """The best place across the valley from one further along it, which the steps do not undo."""
    count, away = len(unit), (unit - here.unit) / np.linalg.norm(unit - here.unit)
    best = few.trials(unit[None], here.nuisance, scale)[0]
    for _ in range(CROSSINGS):
        if not best.total < np.inf:
            break
        jacobian, bend = slopes.at(best.unit, few.for_slopes(best), CLOSE)
        normal, slope = few.quadratic(few.residual(best.predicted, best.nuisance), scale, jacobian, bend)
        matrix = normal.sum(axis=0)
        matrix[:count, :count] += np.trace(matrix) * np.outer(away, away)
        step = bounded_step(matrix, slope.sum(axis=0), best.unit, best.nuisance)
        end = np.clip(best.unit + step[:count], 0.0, 1.0)
        best = min(best, few.trials(end[None], best.nuisance + step[count:], scale)[0], key=lambda t: t.total)
    return best
