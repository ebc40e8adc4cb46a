"""What to record next: the ready motion on which competing models predict the most different signals.

Each model in turn plays the truth and is simulated on every motion; the other one may refit its parameters, as far as
the rollouts at hand leave them open. What it then still gets wrong, over noise, is the expected log-likelihood ratio
of that motion. The smaller of both directions counts: a motion must convince whichever model is right.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from tcbi_infer.compare.replicates import Replicates
from tcbi_infer.diagnose.evidence import DetectableSize, NextMotion
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance
from tcbi_infer.diagnose.least_squares import gram
from tcbi_infer.diagnose.motions import Motion
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.slopes import both_ways

STEP = 0.05  # of a range, of the finite differences
FARTHEST = 0.25  # of a range, that a refit may go
AT_REST_S = 0.5  # s at the beginning that do not count: they tell how the rig was at rest, not how it moves
MOST_RIVALS = 3  # of the best use, for each of which a motion is sought
TELLING = 10.0  # nats: less may come from how the two fits differ by chance, and is no reason to record a motion


def next_motions(
    problem: Problem, names: tuple[str, str], rivals: tuple[Fit, Fit], motions: Sequence[Motion], timestep: float
) -> tuple[NextMotion, ...]:
    """Motions that tell two models apart, the most telling first.

    Args:
      problem: the rollouts at hand; they give signals, noise and autocorrelation.
      names: of the two models' effects; "" for the model without any.
      rivals: their fits to these rollouts.
      motions: what could be recorded.
      timestep: s.
    """
    nats = np.minimum(
        expected_ratio(problem, rivals[0], rivals[1], motions, timestep),
        expected_ratio(problem, rivals[1], rivals[0], motions, timestep),
    )
    return ranked(names, motions, nats)


def motions_that_show(
    problem: Problem, use: str, base: Fit, truth: Fit, motions: Sequence[Motion], timestep: float
) -> tuple[NextMotion, ...]:
    """Motions on which an effect of a given size shows best, the base model refitted."""
    if not motions:
        return ()
    return ranked((use, ""), motions, expected_ratio(problem, truth, base, motions, timestep))


def between(
    problem: Problem,
    uses: Sequence[str],
    base: Fit,
    fits: Mapping[str, Fit],
    motions: Sequence[Motion],
    timestep: float,
) -> tuple[NextMotion, ...]:
    """Motions that tell the best of the uses from each other one, or a single one from the base model.

    Args:
      problem: the rollouts at hand.
      uses: that the verdict names; the best one fitted where it names none.
      base: the base model's fit.
      fits: of uses, best first.
      motions: what could be recorded.
      timestep: s.
    """
    fitted = [use for use in uses if use in fits] if uses else list(fits)
    if not fitted or not motions:
        return ()
    first, *others = fitted[: MOST_RIVALS + 1]
    pairs = [(first, other) for other in others] if len(uses) > 1 and others else [(first, "")]
    found = [next_motions(problem, p, (fits[p[0]], fits.get(p[1], base)), motions, timestep) for p in pairs]
    return tuple(motion for each in found for motion in each)


def planted(base: Fit, use: str, size: DetectableSize | None) -> Fit:
    """The base model's fit with an effect of a size; of its best guess where no size is known."""
    model = base.model.with_effect(use)
    own = []
    for p in model.parameters[len(base.unit) :]:
        value = p.nominal if p.null is None or size is None else p.null
        if size is not None and size.value is not None and p.name == size.parameter:
            value = size.value
        own.append(float(p.to_unit(value)))
    return dataclasses.replace(base, model=model, unit=np.r_[base.unit, own])


def ranked(names: tuple[str, str], motions: Sequence[Motion], nats: np.ndarray) -> tuple[NextMotion, ...]:
    """Motions with what is expected of them, the most telling first."""
    result = []
    for i in np.argsort(-nats):
        m = motions[i]
        table = () if m.command else tuple((float(t), *map(float, row)) for t, row in zip(*_arrays(m), strict=True))
        result.append(NextMotion(m.name, m.description, names, float(nats[i]), m.scenario.duration, m.command, table))
    return tuple(result)


def _arrays(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    return motion.commands.time, motion.commands.target


def expected_ratio(problem: Problem, truth: Fit, other: Fit, motions: Sequence[Motion], timestep: float) -> np.ndarray:
    """(M,) log-likelihood ratio in nats that each motion is expected to give against `other` if `truth` is right."""
    planned = _planned(problem, truth, motions, timestep)
    sets = np.arange(len(motions))
    fitter = Fitter(planned, other.model, Nuisance.none(planned), sets, timestep)
    predicted = fitter.predict(other.unit[None])[0]
    slopes, bend, refit = _slopes(fitter, other.unit, predicted)
    scale = np.minimum(truth.scale, other.scale)
    residual = planned.residual(predicted)
    fine = np.isfinite(residual).all(axis=(1, 2)) & refit
    residual = np.nan_to_num(residual)
    normal, slope = gram(slopes, residual, fitter.precision(residual, scale, bend))
    known = _known(other)
    # where a prediction turns with the smallest change, the motion proves nothing
    certainty = 1.0 / np.sqrt(1.0 + (bend / (problem.floor * scale[problem.group])) ** 2)
    nats = np.zeros(len(motions))
    nothing = planned.loss(np.zeros_like(residual), scale)
    for s in sets[fine]:
        step = np.clip(np.linalg.solve(known + normal[s], slope[s]), -FARTHEST, FARTHEST)
        left = (residual[s] - slopes[s] @ step) * certainty[s]
        nats[s] = planned.loss(left[None], scale, np.array([s]))[0] - nothing[s] + 0.5 * step @ known @ step
    return nats


def _slopes(fitter: Fitter, unit: np.ndarray, predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slopes (M, T, C, P) and departures (M, T, C), each motion's from the probes that do not diverge in it.

    And (M,) whether these move every parameter: else a refit cannot be told, and the motion is not recommended.
    """
    moves = np.concatenate([both_ways(unit, axis, STEP) for axis in np.eye(len(unit))]) - unit
    change = fitter.predict(unit + moves) - predicted
    alive = np.isfinite(change).all(axis=(2, 3))  # (n, M)
    lines = [_straight(moves[fine], change[fine, m]) for m, fine in enumerate(alive.T)]
    slopes, bends = (np.array(each) for each in zip(*lines, strict=True))
    return slopes, bends, np.array([moves[fine].any(axis=0).all() for fine in alive.T])


def _straight(moves: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The slopes (..., P) of changes (n, ...) of a prediction with moves (n, P), and the root mean square departure."""
    slopes = np.einsum("pn,n...->...p", np.linalg.pinv(moves), change)
    departure = change - np.einsum("np,...p->n...", moves, slopes)
    freedom = max(len(moves) - moves.shape[1], 1)
    return slopes, np.sqrt((departure**2).sum(axis=0) / freedom)


def _known(fit: Fit) -> np.ndarray:
    """(P, P) precision of a fit's parameters from the rollouts at hand, nuisances integrated out."""
    count = len(fit.unit)
    whole = fit.normal.sum(axis=0) + np.diag(np.r_[np.full(count, 3.0), np.ones(len(fit.nuisance))])
    cross = whole[:count, count:]
    return whole[:count, :count] - cross @ np.linalg.solve(whole[count:, count:], cross.T)


def _planned(problem: Problem, truth: Fit, motions: Sequence[Motion], timestep: float) -> Problem:
    """The motions as a problem whose data are a model's predictions, without noise."""
    old = problem.replay
    end = max(m.scenario.duration for m in motions)
    time = np.arange(1, int(np.floor(end * old.layout.rate + 1e-6)) + 1) / old.layout.rate
    replay = dataclasses.replace(
        old,
        measurements=(),
        time=time,
        measured=np.empty((0, len(time), len(old.layout.channels))),
        replicates=tuple(Replicates((i,), i) for i in range(len(motions))),
        scenarios=tuple(m.scenario for m in motions),
        commands=tuple(m.commands for m in motions),
    )
    observed = replay.predict(truth.model, truth.parameters[None], timestep=timestep)[0]
    measured = (problem.weight > 0).any(axis=(0, 1))
    lasts = np.array([m.scenario.duration for m in motions])[:, None] >= time - 1e-6
    counted = (lasts & (time > AT_REST_S))[..., None]
    weight = (old.layout.kept(len(time)) & measured & counted & np.isfinite(observed)).astype(float)
    return dataclasses.replace(problem, replay=replay, observed=observed, weight=weight, kind=np.arange(len(motions)))


def best(motions: Sequence[NextMotion]) -> list[NextMotion]:
    """The most telling motion for each pair of models that one of them tells apart."""
    firsts = {m.between: m for m in reversed(motions)}
    return [m for m in firsts.values() if m.nats >= TELLING]


def advice(motions: Sequence[NextMotion]) -> list[str]:
    """For people: the best motion for each pair of models, or that none of the ready ones tells them apart."""
    lines = []
    for pair in dict.fromkeys(m.between for m in motions):
        mine = [m for m in motions if m.between == pair]
        first, second = (name or "a model without it" for name in pair)
        told = mine[0]
        if told.nats < TELLING:
            lines.append(
                f"None of {len(mine)} ready motions tells {first} from {second}: at best {told.nats:.1f} nats "
                f"({told.motion})."
            )
            continue
        others = "".join(f", {m.motion} {m.nats:.0f}" for m in mine[1:3])
        lines.append(
            f"To tell {first} from {second}, record {told.motion} ({told.description}): {told.nats:.0f} nats of "
            f"evidence expected in {told.duration_s:g} s{others}."
        )
    return lines
