"""Whether a fitted parameter has one value for all kinds of motion, or each kind would rather have its own.

Each kind's own value is one Gauss-Newton step from the common fit, with that kind's normal equations alone. How far
such values scatter although the parameter is one and the same is learnt from the fit's own residual: shifted in time
and with a random sign, it is an error as large, as smooth and as common to the signals as the real one, but no longer
in step with what the parameter does. Cochran's Q of the real values is compared with that of such errors. So noise,
autocorrelation and ordinary model error are all in what disagreement is measured against.
"""

from collections.abc import Sequence

import numpy as np

from tcbi_contract.wording import with_unit
from tcbi_infer.diagnose.evidence import Agreement, KindValue
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance
from tcbi_infer.diagnose.heldout import fold_indices
from tcbi_infer.diagnose.problem import Problem

DRAWS = 4000
LEVEL = 0.01  # of the test, shared among a model's parameters
REACH = 0.25  # of a range: no kind's value is sought farther from the common one
DETERMINED = 0.1  # of a range: a kind that knows a parameter worse has no say
RELEVANT = 0.2  # of a parameter's size: smaller differences between kinds harm no user
LEAST_KINDS = 3  # of motion that know a parameter
PRIOR = 1e-3  # of the inverse variance of a parameter, as in the fit


def agreement(
    problem: Problem, fit: Fit, nuisance: Nuisance, sets: np.ndarray, covariance: np.ndarray, seed: int = 0
) -> tuple[Agreement, ...]:
    """Each parameter's values by kind of motion, and whether they agree.

    Args:
      problem: the data.
      fit: to all open sets.
      nuisance: scatter between joints; each kind may have its own, within its prior about the common one.
      sets: the open ones.
      covariance: (P, P) of the common values in unit space, as their 90 % intervals have it.
      seed: of the draws.
    """
    folds = fold_indices(problem, sets)
    steps, curvature = _steps(problem, fit, nuisance, sets, folds)
    variance = np.maximum((steps**2).mean(axis=1), curvature)
    known = variance <= DETERMINED**2
    rng = np.random.default_rng(seed)
    drawn = steps[np.arange(len(folds)), rng.integers(steps.shape[1], size=(DRAWS, len(folds)))]  # (D, F, P)
    names, result = _names(problem, sets, folds), []
    half = 1.645 * np.sqrt(np.diag(covariance))
    for i in range(len(fit.unit)):
        kinds = np.flatnonzero(known[:, i])
        own, deviation = steps[kinds, 0, i], np.sqrt(variance[kinds, i])
        p = spread = None
        if len(kinds) >= LEAST_KINDS:
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
    problem: Problem, fit: Fit, nuisance: Nuisance, sets: np.ndarray, folds: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(F, 2 T, P) steps of each kind for its residual (first), for all its shifts in time, and all their negatives.

    And (F, P) variances from the curvature alone.
    """
    weight = Fitter(problem, fit.model, nuisance, sets, 0.0).precision(fit.residual, fit.scale, fit.bend)
    count, length = len(fit.unit), fit.residual.shape[1]
    prior = np.diag(np.r_[np.full(count, PRIOR), np.ones(len(fit.nuisance))])
    low, high = np.maximum(-fit.unit, -REACH), np.minimum(1.0 - fit.unit, REACH)
    steps, curvature = np.empty((len(folds), 2 * length, count)), np.empty((len(folds), count))
    for f, fold in enumerate(folds):
        pull = np.zeros((length, count + len(fit.nuisance)))
        for s in fold:
            design = np.concatenate([fit.jacobian[s], nuisance.effect[sets[s]]], axis=-1)
            spectrum = np.fft.rfft(weight[s][..., None] * design, axis=0)
            shifted = np.conj(np.fft.rfft(fit.residual[s], axis=0))
            pull += np.fft.irfft(np.einsum("tck,tc->tk", spectrum, shifted), n=length, axis=0)
        inverse = np.linalg.inv(fit.normal[fold].sum(axis=0) + prior)
        step = (pull @ inverse)[:, :count]
        steps[f] = np.clip(np.concatenate([step, -step]), low, high)
        curvature[f] = np.diag(inverse)[:count]
    return steps, curvature


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
        told = f"{name}: too few kinds of motion know it alone to say whether they agree."
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
