"""Whether a fitted parameter has one value for all kinds of motion, or each kind would rather have its own.

Each kind's own value is one Gauss-Newton step from the common fit, with that kind's normal equations alone. How far
such values scatter although the parameter is one and the same is learnt from the fit's own residual: shifted in time
and with a random sign, it is an error as large, as smooth and as common to the signals as the real one, but no longer
in step with what the parameter does. Cochran's Q of the real values is compared with that of such errors. So noise,
autocorrelation and ordinary model error are all in what disagreement is measured against. Where a shift changes
nothing, since the parameter does the same at all times, there are no such errors to compare with: nothing is told.
"""

import math
from collections.abc import Sequence

import numpy as np

from tcbi_contract.wording import with_unit
from tcbi_infer.compare.signals import Layout
from tcbi_infer.diagnose.evidence import Agreement, KindValue
from tcbi_infer.diagnose.fit import Fit, Fitter
from tcbi_infer.diagnose.heldout import fold_indices
from tcbi_infer.diagnose.least_squares import prior_precision
from tcbi_infer.diagnose.problem import Problem

DRAWS = 4000
LEVEL = 0.01  # of the test, shared among a model's parameters
REACH = 0.25  # of a range: no kind's value is sought farther from the common one
DETERMINED = 0.1  # of a range: a kind that knows a parameter worse has no say
RELEVANT = 0.2  # of a parameter's size: smaller differences between kinds harm no user
LEAST_KINDS = 3  # of motion that know a parameter
VARIES = 0.1  # part of the shifted values' mean square that must differ between shifts


def agreement(
    problem: Problem, fit: Fit, sets: np.ndarray, covariance: np.ndarray, seed: int = 0
) -> tuple[Agreement, ...]:
    """Each parameter's values by kind of motion, and whether they agree.

    Args:
      problem: the data.
      fit: to all open sets; each kind may have its own scatter between joints, within its prior about the common one.
      sets: the open ones.
      covariance: (P, P) of the common values in unit space, as their 90 % intervals have it.
      seed: of the draws.
    """
    folds = fold_indices(problem, sets)
    steps, curvature, part = _steps(problem, fit, sets, folds)
    variance = np.maximum([np.mean(s**2, axis=0) for s in steps], curvature)
    known = variance <= DETERMINED**2
    rng = np.random.default_rng(seed)
    drawn = np.stack([s[rng.integers(len(s), size=DRAWS)] for s in steps], axis=1)  # (D, F, P)
    names, result = _names(problem, sets, folds), []
    half = 1.645 * np.sqrt(np.diag(covariance))
    for i in range(len(fit.unit)):
        kinds = np.flatnonzero(known[:, i])
        own, deviation = np.array([steps[k][0, i] for k in kinds]), np.sqrt(variance[kinds, i])
        p = spread = None
        if len(kinds) >= LEAST_KINDS and _tells([steps[k] for k in kinds], part[kinds, i], LEVEL / len(fit.unit)):
            real, spread = _scatter(own, deviation)
            p = float(1 + np.sum(_scatter(drawn[:, kinds, i], deviation)[0] >= real)) / (DRAWS + 1)
        values = tuple(
            KindValue(names[k], *_physical(fit, i, fit.unit[i] + step + 1.645 * sd * np.array([0.0, -1.0, 1.0])))
            for k, step, sd in zip(kinds, own, deviation, strict=True)
        )
        result.append(_judged(fit, i, values, p, spread, half[i]))
    return tuple(result)


def disagreeing(found: Sequence[Agreement]) -> list[Agreement]:
    """Those whose kinds of motion do not agree."""
    return [a for a in found if a.agrees is False]


def _steps(
    problem: Problem, fit: Fit, sets: np.ndarray, folds: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """(2 N, P) steps of each kind for its residual (first), for its N shifts in time, and all their negatives.

    Also (F, P) variances from the curvature alone, and (F, P) parts of the steps' mean squares that differ between
    shifts if outliers weigh as little wherever they are shifted to: else a few of these would differ for them all.
    """
    fitter, count = Fitter(problem, fit.model, fit.scatter, sets, 0.0), len(fit.unit)
    weight = fitter.precision(fit.residual, fit.scale, fit.bend)
    weighted = fitter.precision(fit.residual, fit.scale, np.zeros_like(fit.bend)) * fit.residual
    every = _common_period(problem.replay.layout)
    prior = np.diag(prior_precision(count, len(fit.nuisance)))
    low, high = np.maximum(-fit.unit, -REACH), np.minimum(1.0 - fit.unit, REACH)
    steps, curvature, part = [], np.empty((len(folds), count)), np.zeros((len(folds), count))
    for f, fold in enumerate(folds):
        inverse = np.linalg.inv(fit.normal[fold].sum(axis=0) + prior)
        pulls, moved = [], []
        for s in fold:
            design = np.concatenate([fit.jacobian[s], fit.scatter.effect[sets[s]]], axis=-1)
            there = _there(problem, sets[s])
            pulls.append(_pulls(weight[s][..., None] * design, fit.residual[s], there, every))
            moved.append(_pulls(design, weighted[s], there, every))
        step = _together(pulls) @ inverse[:, :count]
        steps.append(np.clip(np.concatenate([step, -step]), low, high))
        curvature[f] = np.diag(inverse)[:count]
        shifted = _together(moved) @ inverse[:, :count]
        square = np.mean(shifted**2, axis=0)
        np.divide(shifted.var(axis=0), square, out=part[f], where=square > 0)
    return steps, curvature, part


def _common_period(layout: Layout) -> int:
    """Samples after which the moments at which averages are compared come round again, in all fitted channels."""
    return math.lcm(*(layout.samples_in(c.group) for c in layout.channels if c.group.fitted))


def _there(problem: Problem, s: int) -> slice:
    """From the first to the last sample of a set that counts."""
    counts = np.flatnonzero(problem.weight[s].any(axis=1))
    return slice(counts[0], counts[-1] + 1) if len(counts) else slice(0, 0)


def _pulls(design: np.ndarray, residual: np.ndarray, there: slice, every: int) -> np.ndarray:
    """(N, K) products of a design (T, C, K) and a residual (T, C), one of them weighted, for each shift by `every`.

    The residual goes round within as many whole multiples as the set has samples; the few after these stay in place.
    """
    turns = (there.stop - there.start) // every
    whole = slice(there.start, there.start + turns * every)
    still = np.einsum("tck,tc->k", design, residual)
    if turns < 2:
        return still[None]
    parts = (turns, every, residual.shape[1])
    spectrum = np.fft.rfft(design[whole].reshape(*parts, -1), axis=0)
    shifted = np.conj(np.fft.rfft(residual[whole].reshape(parts), axis=0))
    moving = np.fft.irfft(np.einsum("njck,njc->nk", spectrum, shifted), n=turns, axis=0)
    return still + moving - moving[0]


def _together(pulls: Sequence[np.ndarray]) -> np.ndarray:
    """(N, K) sum over the sets of a kind; a short one has gone round before the longest has."""
    shifts = np.arange(max(len(pull) for pull in pulls))
    return np.sum([pull[shifts % len(pull)] for pull in pulls], axis=0)


def _tells(steps: Sequence[np.ndarray], part: np.ndarray, level: float) -> bool:
    """Whether shifts could show a disagreement of kinds: their steps differ enough, and there are enough to draw from.

    The sign of all kinds together does not change how far they are apart.
    """
    return bool(math.prod(len(s) for s in steps) / 2 * level > 1.0 and part.mean() > VARIES)


def _scatter(values: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cochran's Q of (..., F) values, and their weighted standard deviation between kinds."""
    weight, count = deviation**-2.0, len(deviation)
    mean = (weight * values).sum(axis=-1, keepdims=True) / weight.sum()
    q = (weight * (values - mean) ** 2).sum(axis=-1)
    return q, np.sqrt(q / weight.sum() * count / (count - 1))


def _judged(
    fit: Fit, i: int, values: tuple[KindValue, ...], p: float | None, spread: np.ndarray | None, half: float
) -> Agreement:
    """What is said of one parameter; `half` is half its interval in unit space."""
    parameter, value = fit.model.parameters[i], float(fit.parameters[i])
    name, agrees = parameter.name, None
    if p is None or spread is None:
        told = (
            f"{name}: too few kinds of motion know it alone to say whether they agree."
            if len(values) < LEAST_KINDS
            else f"{name}: whether the kinds of motion agree cannot be told, as what it changes hardly varies in time "
            "or the motions are too short."
        )
        return Agreement(name, parameter.unit, value, agrees, told, values)
    ends = _physical(fit, i, fit.unit[i] + np.array([-half, half, -spread, spread]))
    size = max(abs(value - (parameter.null or 0.0)), (ends[1] - ends[0]) / 2)
    apart = (ends[3] - ends[2]) / 2
    agrees = not (p < LEVEL / len(fit.unit) and apart > RELEVANT * size)
    least, most = (pick(values, key=lambda v: v.value) for pick in (min, max))
    told = (
        f"{name}: the kinds of motion agree on {with_unit(f'{value:.3g}', parameter.unit)}."
        if agrees
        else f"{name}: the kinds of motion disagree, from {least.value:.3g} ({least.kind}) to "
        f"{with_unit(f'{most.value:.3g}', parameter.unit)} ({most.kind}); no one value holds for all."
    )
    return Agreement(name, parameter.unit, value, agrees, told, values, p)


def _physical(fit: Fit, i: int, unit: np.ndarray) -> list[float]:
    """Unit values of one parameter, kept in its range, in its own unit."""
    return [float(v) for v in fit.model.parameters[i].from_unit(np.clip(unit, 0.0, 1.0))]


def _names(problem: Problem, sets: np.ndarray, folds: Sequence[np.ndarray]) -> list[str]:
    """What each kind of motion is called: its policy, where that tells it from the others."""
    replay = problem.replay
    firsts = [replay.measurements[replay.replicates[sets[fold[0]]].members[0]] for fold in folds]
    names = [m.policy_id.partition("@")[0] for m in firsts]
    return [n if n and names.count(n) == 1 else f"{n or 'motion'} {k}" for k, n in enumerate(names, 1)]
