"""The fit of the base model, which every candidate has to beat: a bad one would make any effect look missing."""

import itertools
from collections.abc import Sequence

import numpy as np

from tcbi_infer.diagnose.escape import leapt
from tcbi_infer.diagnose.fit import RACE, Fit, Fitter, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.scatter import joint_scatter, relinearised
from tcbi_infer.diagnose.search import Progress
from tcbi_infer.diagnose.settings import Settings
from tcbi_sim.model import Model

GRID = (0.15, 0.5, 0.85)  # of each base parameter's range
CORNERS = (0.3, 0.7)  # instead, of more than four parameters
WIDEST = 7  # parameters whose corners are all tried; of more so many are drawn:
CORNER_STARTS = 2**WIDEST
KNOWN = 2  # of the starts stand for what is known of the model; the others are that grid
# by so much must the base model's fit improve from a candidate's parameters, to begin again there: nats, and a share of
# what the best candidate gains
BETTER, BETTER_SHARE = 3.0, 0.1
NEAR = 0.05  # of every range: who starts so near to another start, or to the base model's fit, falls back to it


def base_starts(model: Model) -> np.ndarray:
    """(N, P) unit vectors from which a base model is fitted: its mean, its nominal values, and a grid.

    Of a model with many parameters the grid is of corners drawn at random, none of them twice.
    """
    width = len(model.parameters)
    if width <= WIDEST:
        grid = np.array(list(itertools.product(GRID if width <= 4 else CORNERS, repeat=width)))
    else:
        drawn = np.random.default_rng(0).choice(CORNERS, (4 * CORNER_STARTS, width))
        grid = np.array(list(dict.fromkeys(map(tuple, drawn)))[:CORNER_STARTS])
    nominal = np.array([p.nominal for p in model.parameters])
    known = np.clip(model.to_unit(np.array([model.mean(), nominal])), 0.0, 1.0)
    return np.concatenate([known, grid])


def fit_base(
    problem: Problem, model: Model, sets: np.ndarray, settings: Settings, progress: Progress
) -> tuple[Problem, Fit]:
    """The base model's parameters from a grid of starts, then again with scatter between joints allowed for.

    Args:
      problem: whose residuals count as independent.
      model: to fit.
      sets: of replicates that the fit may see.
      settings: how thorough.
      progress: called with the stage and the share done.

    Returns:
      the problem with the autocorrelation of what the first fit left, and the fit.
    """
    progress("fitting the base model", 0.0)
    starts = base_starts(model)
    everything = Fitter(problem, model, Nuisance.none(problem), sets, settings.coarse)
    near = everything.on_few_sets().run(starts, radii=(0.12, 0.08, 0.06), valleys=False)
    first = everything.run(np.concatenate([near.unit[None], starts[:KNOWN]]), radii=(0.08,), most=1)
    full = np.zeros_like(problem.observed)
    full[sets] = first.residual
    problem = problem.with_autocorrelation(full)
    progress("fitting the base model", 0.05)
    again = Fitter(problem, model, joint_scatter(problem, first, sets, settings.coarse), sets, settings.coarse)
    fit = again.run(first.unit[None])
    return problem, leapt(again, fit, len(model.parameters)) if settings.escape else fit


def better_base(
    problem: Problem,
    sets: np.ndarray,
    settings: Settings,
    base: Fit,
    candidates: Sequence[Fit],
    progress: Progress,
) -> Fit | None:
    """The base model's fit from a candidate's base parameters, where that is better: else the candidate would be
    credited with a valley that the base model was never shown.

    Each far start is fitted a little to few sets first, and so is where the base model's fit ended: without the effect
    most fall back to it.

    Args:
      base: the base model's fit with coarse steps.
      candidates: fits of candidates with coarse steps; the base model's parameters stand before the effect's.
    """
    starts: list[np.ndarray] = []
    for fit in candidates:
        start = fit.unit[: len(base.unit)]
        if min(np.max(np.abs(start - other)) for other in (base.unit, *starts)) > NEAR:
            starts.append(start)
    if not starts:
        return None
    progress("fitting the base model again", 0.96)
    fitter = Fitter(problem, base.model, base.scatter, sets, settings.coarse)
    few = fitter.on_few_sets()
    here, *raced = (few.run(start[None], radii=RACE, valleys=False) for start in (base.unit, *starts))
    best = min(raced, key=lambda fit: fit.total)
    least = max(BETTER, BETTER_SHARE * (base.total - min(fit.total for fit in candidates)))
    if here.total - best.total < least * len(few.sets) / len(sets):
        return None
    found = relinearised(problem, fitter.run(best.unit[None]), sets, settings.coarse)
    return found if base.total - found.total > least else None
