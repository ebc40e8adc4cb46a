"""Screening: every use of every effect, simulated at a few sizes around the fitted base model; then linear algebra.

For each size the change of the prediction is a direction. The base parameters and the nuisances are profiled out of the
residual along it. All that cross-validation and the null simulations need are inner products, set by set, so that
hundreds of simulated null data sets cost no further simulation.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from tcbi_infer.diagnose.at_random import at_random
from tcbi_infer.diagnose.fit import Fit, Fitter
from tcbi_infer.diagnose.least_squares import prior_precision
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import Model
from tcbi_sim.workers import Here, present

SIZES = (0.1, 0.35)  # of the range on one side of the null value
CORNERS = (0.2, 0.8)  # of the range of a parameter without a null value
ONE_SIZE = 0.2  # where one effect has many places
NO_ROOM = 0.05  # of a range
MOST_STRETCH = 1.6  # of a direction beyond the simulated size
INFLUENCE = 0.15  # of the noise floor: less than this at every size is no influence


@dataclasses.dataclass(frozen=True)
class Directions:
    """Simulated changes of the prediction by candidate effects.

    Attributes:
      use: (K,) which use each direction belongs to, as an index into `uses`.
      unit: K vectors of the effect's own parameters in [0, 1].
      change: (K, S, T, C) of the open sets.
      least, most: (K,) multiples between which the effect stays inside its range.
      untestable: uses that change nothing; `diverging` those whose simulations diverge at every size; `random` those by
        which commands get lost, others in a replay than the robot lost.
    """

    uses: tuple[str, ...]
    models: tuple[Model, ...]
    use: np.ndarray
    unit: tuple[np.ndarray, ...]
    change: np.ndarray
    least: np.ndarray
    most: np.ndarray
    untestable: tuple[str, ...]
    diverging: tuple[str, ...] = ()
    random: tuple[str, ...] = ()


def effect_points(model: Model, base_count: int, many: bool) -> np.ndarray:
    """(n, q) unit vectors of an effect's own parameters at which to look, around its null values.

    Two sizes of each parameter that has a null value, and all of them together; those that have none, and say where or
    how, stand at their nominal values and, with the larger size, at the corners of their ranges. A single point for an
    effect with one parameter and many places, where the straight line through it has to do; and one size each way of
    a tilt, a bias or a moment, whose null value lies inside its range, among several parameters: such an effect has no
    threshold, and `with_sums` has several of them together.
    """
    own = model.parameters[base_count:]
    nominal = np.array([float(p.to_unit(p.nominal)) for p in own])
    null = _own_null(model, base_count)
    sized, placed = np.nonzero(np.isfinite(null))[0], np.nonzero(~np.isfinite(null))[0]
    if many and len(own) == 1 and len(sized):
        up = 1 - null[0] >= null[0]
        return np.array([[null[0] + ONE_SIZE * (1 - null[0] if up else -null[0])]])
    rest = np.where(np.isfinite(null), null, nominal)
    corners = itertools.product(CORNERS, repeat=len(placed)) if len(placed) else ()
    places = [rest[placed], *map(np.array, corners)]
    points = []
    for i in sized:
        ways = [(sign, room) for sign, room in ((1, 1 - null[i]), (-1, null[i])) if room >= NO_ROOM]
        sizes = SIZES if len(ways) == 1 or len(own) == 1 else SIZES[-1:]
        for (sign, room), size in itertools.product(ways, sizes):
            for place in places if size == SIZES[-1] else places[:1]:
                point = rest.copy()
                point[placed] = place
                point[i] = null[i] + sign * size * room
                points.append(point)
    both_ways = not len(placed) and bool(np.any(np.minimum(null, 1 - null) >= NO_ROOM))
    for ends in itertools.product((0.0, 1.0), repeat=len(sized)) if len(sized) > 1 and not both_ways else ():
        point = rest.copy()
        point[sized] += SIZES[-1] * (np.array(ends) - point[sized])
        if not np.allclose(point[sized], null[sized]):
            points.append(point)
    return np.unique(points, axis=0)


def with_sums(null: np.ndarray, points: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of a tilt or a bias about several axes, (n, q), and beside them those about several axes at once.

    What these change is taken as the sum of what each axis alone changes, (n, ...): small turns and biases add up.

    Args:
      null: (q,) in the unit cube.
      points: (n, q) in which one parameter each is off its null value.
      change: (n, ...) of the prediction.
    """
    axes = [[*np.flatnonzero(points[:, i] != null[i]), None] for i in range(len(null))]
    sums = [[k for k in chosen if k is not None] for chosen in itertools.product(*axes)]
    several = [chosen for chosen in sums if len(chosen) > 1]
    further = [null + (points[chosen] - null).sum(axis=0) for chosen in several]
    return np.array([*points, *further]), np.array([*change, *(change[chosen].sum(axis=0) for chosen in several)])


def simulate_directions(
    problem: Problem,
    base: Fit,
    uses: Sequence[str],
    sets: np.ndarray,
    timestep: float,
    progress: Callable[[str], None] | None = None,
) -> Directions:
    """Simulates every use at a few sizes, base parameters at the base fit; sets that diverge there show no change."""
    reference = problem.replay.predict(base.model, base.parameters[None], list(sets), timestep)[0]
    names = [use.partition(":")[0] for use in uses]
    random = tuple(use for use in uses if at_random(base.model, use))
    uses = [use for use in uses if use not in random]
    candidates = [_candidate(base, use, names) for use in uses]
    predicted = _predictions(problem, base.unit, list(sets), timestep, candidates, progress)
    counted = (problem.weight[list(sets)] > 0) & np.isfinite(reference)
    owner, units, changes, bounds, models, untestable, diverging, kept = [], [], [], [], [], [], [], []
    for use, (model, points), values in zip(uses, candidates, predicted, strict=True):
        change = np.where(counted, values - reference, 0.0)
        alive = np.isfinite(change).all(axis=(1, 2, 3)) & counted.any()
        if not alive.any():
            diverging.append(use)
            continue
        if _influence(problem, change[alive], sets) < INFLUENCE:
            untestable.append(use)
            continue
        null = _own_null(model, len(base.unit))
        if len(null) > 1 and alive.all() and np.all((points != null).sum(axis=1) == 1):
            points, change = with_sums(null, points, change)
            alive = np.ones(len(points), bool)
        kept.append(use)
        models.append(model)
        for k in np.nonzero(alive)[0]:
            owner.append(len(kept) - 1)
            units.append(points[k])
            changes.append(change[k])
            bounds.append(_room(model, len(base.unit), points[k], len(points) == 1))
    least, most = np.array(bounds).reshape(-1, 2).T
    change = np.array(changes) if changes else np.empty((0, *reference.shape))
    return Directions(
        tuple(kept),
        tuple(models),
        np.array(owner, int),
        tuple(units),
        change,
        least,
        most,
        tuple(untestable),
        tuple(diverging),
        random,
    )


class Candidate(NamedTuple):
    """A use, and where to look at it."""

    model: Model
    points: np.ndarray  # (n, q)


def _candidate(base: Fit, use: str, names: list[str]) -> Candidate:
    """Where to look at a use.

    Of a joint's gain, of which a nuisance takes up all that is linear: far out, on the side to which that leans.
    """
    model = base.model.with_effect(use)
    name, _, joint = use.partition(":")
    if name == "gain_scatter" and joint in base.scatter.names:
        null, leans = float(model.parameters[-1].to_unit(1.0)), base.nuisance[base.scatter.names.index(joint)]
        return Candidate(model, np.array([[null + SIZES[-1] * (1.0 - null if leans > 0 else -null)]]))
    return Candidate(model, effect_points(model, len(base.unit), names.count(name) > 1))


def _predictions(
    problem: Problem,
    unit: np.ndarray,
    sets: list[int],
    timestep: float,
    candidates: list[Candidate],
    progress: Callable[[str], None] | None,
) -> list[np.ndarray]:
    """(n, open sets, T, C) for each candidate: each a chunk for the workers, unless these outnumber them."""
    them = present() if len(candidates) >= present().processors else Here()
    count = itertools.count()

    def told(_: float) -> None:
        if progress:
            progress(candidates[next(count)].model.effects[-1])

    return them.map(functools.partial(_predicted, problem, unit, sets, timestep), candidates, told)


def _predicted(
    problem: Problem, unit: np.ndarray, sets: list[int], timestep: float, candidate: Candidate
) -> np.ndarray:
    model, points = candidate
    vectors = np.concatenate([np.repeat(unit[None], len(points), axis=0), points], axis=1)
    return problem.replay.predict(model, model.from_unit(vectors), sets, timestep)


def _own_null(model: Model, base_count: int) -> np.ndarray:
    """(q,) null values of an effect's own parameters in the unit cube, NaN where one has none."""
    own = model.parameters[base_count:]
    return np.array([float(p.to_unit(p.null)) if p.null is not None else np.nan for p in own])


def _influence(problem: Problem, change: np.ndarray, sets: np.ndarray) -> float:
    """The largest root mean square change of any channel, over its noise floor."""
    weight = problem.weight[list(sets)]
    count = np.maximum(weight.sum(axis=(0, 1)), 1)
    squares = ((change / problem.floor) ** 2 * weight).sum(axis=(1, 2)) / count
    return float(np.sqrt(squares.max()))


def _room(model: Model, base_count: int, point: np.ndarray, both_ways: bool) -> tuple[float, float]:
    """Multiples of `point`, seen from the null, between which the effect stays inside its ranges."""
    least, most = (-np.inf if both_ways else 0.0), MOST_STRETCH if not both_ways else np.inf
    for p, value in zip(model.parameters[base_count:], point, strict=True):
        if p.null is None:
            continue
        null = float(p.to_unit(p.null))
        forward, backward = (1.0 - null, null) if value > null else (null, 1.0 - null)
        size = abs(value - null)
        if size > 1e-9:
            most, least = min(most, forward / size), max(least, -backward / size)
    return float(least), float(most)


@dataclasses.dataclass(frozen=True)
class Moments:
    """Inner products, set by set, of nuisance directions (n: base parameters and scatter) and effect directions (k)."""

    nn: np.ndarray  # (S, n, n)
    nk: np.ndarray  # (S, n, K)
    kk: np.ndarray  # (S, K) of each direction with itself
    prior: np.ndarray  # (n,) precision


@dataclasses.dataclass(frozen=True)
class Targets:
    """Inner products, set by set, of D data sets with the directions."""

    nr: np.ndarray  # (S, n, D)
    kr: np.ndarray  # (S, K, D)


class Screen:
    """One-step, cross-validated score of every direction, for the data and for simulated null data.

    Attributes:
      data: of the measurements: what the base fit leaves, its nuisances put back, for their prior is centred on none of
        them, here as in null data; with D = 1.
    """

    def __init__(self, problem: Problem, base: Fit, directions: Directions, sets: np.ndarray) -> None:
        self.sets = np.asarray(sets, int)
        self.directions = directions
        count = len(self.sets)
        fitter = Fitter(problem, base.model, base.scatter, sets, timestep=0.0)
        self.precision = fitter.precision(base.residual, base.scale, base.bend).reshape(count, -1)
        self.independent = float((problem.weight[self.sets] * problem.share[problem.group]).sum())
        design = np.concatenate([base.jacobian, base.scatter.effect[self.sets]], axis=-1)
        self.design = design.reshape(count, -1, design.shape[-1])
        self.change = directions.change.reshape(len(directions.change), count, -1)
        self.base_count = len(base.unit)
        prior = prior_precision(self.base_count, len(base.nuisance))
        weighted = self.design * self.precision[..., None]
        self.moments = Moments(
            np.einsum("sin,sim->snm", weighted, self.design, optimize=True),
            np.einsum("sin,ksi->snk", weighted, self.change, optimize=True),
            np.einsum("ksi,si->sk", self.change**2, self.precision, optimize=True),
            prior,
        )
        kinds = problem.kind[self.sets]
        self.folds = [np.nonzero(kinds == k)[0] for k in dict.fromkeys(kinds)]
        self.sizes = np.array([len(fold) for fold in self.folds])
        self.data = self.targets((base.residual + base.scatter.effect[self.sets] @ base.nuisance)[None])

    def targets(self, residuals: np.ndarray) -> Targets:
        """Inner products of (D, S, T, C) residuals with all directions."""
        flat = residuals.reshape(len(residuals), len(self.sets), -1) * self.precision
        return Targets(
            np.einsum("sin,dsi->snd", self.design, flat, optimize=True),
            np.einsum("ksi,dsi->skd", self.change, flat, optimize=True),
        )

    def unit_scale(self, residuals: np.ndarray) -> np.ndarray:
        """(D,) factors that bring (D, S, T, C) residuals to the scale that a fit of them would have estimated."""
        flat = residuals.reshape(len(residuals), len(self.sets), -1)
        squares = np.einsum("dsi,dsi,si->d", flat, flat, self.precision, optimize=True)
        return np.sqrt(self.independent / np.maximum(squares, 1e-12))

    def solve(self, targets: Targets, train: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Least squares on some sets, along each direction.

        Returns:
          alpha (K, D) the size in [least, most]; gain (K, D) of the training score; base (n, D) the nuisances without
          any effect; slope (n, K) by which a unit of each effect shifts them.
        """
        m = self.moments
        inverse = np.linalg.inv(m.nn[train].sum(axis=0) + np.diag(m.prior))
        nk, kk = m.nk[train].sum(axis=0), m.kk[train].sum(axis=0)
        nr, kr = targets.nr[train].sum(axis=0), targets.kr[train].sum(axis=0)
        slope = inverse @ nk
        curvature = np.maximum(kk - np.einsum("nk,nk->k", nk, slope), 1e-9 * kk + 1e-12)[:, None]
        pull = kr - slope.T @ nr
        alpha = np.clip(pull / curvature, self.directions.least[:, None], self.directions.most[:, None])
        return alpha, alpha * pull - 0.5 * alpha**2 * curvature, inverse @ nr, slope

    def held_out(self, targets: Targets) -> np.ndarray:
        """(F, U, D) gain in nats of each use on each fold, fitted to the other folds only.

        Within a use the best direction is chosen on the training folds, as a fit would.
        """
        m, uses = self.moments, len(self.directions.uses)
        gains = np.zeros((len(self.folds), uses, targets.nr.shape[-1]))
        everything = np.arange(len(self.sets))
        for f, fold in enumerate(self.folds):
            train = np.setdiff1d(everything, fold)
            alpha, score, base, slope = self.solve(targets, train)
            nn, nk, kk = m.nn[fold].sum(axis=0), m.nk[fold].sum(axis=0), m.kk[fold].sum(axis=0)
            nr, kr = targets.nr[fold].sum(axis=0), targets.kr[fold].sum(axis=0)
            # the step is base - slope * alpha for the nuisances, alpha for the effect
            linear = kr - slope.T @ nr
            cross = nk.T @ base - slope.T @ (nn @ base)
            own = kk - 2 * np.einsum("nk,nk->k", nk, slope) + np.einsum("nk,nk->k", slope, nn @ slope)
            gain = alpha * (linear - cross) - 0.5 * alpha**2 * own[:, None]
            for u in range(uses):
                mine = np.nonzero(self.directions.use == u)[0]
                best = mine[np.argmax(score[mine], axis=0)]
                gains[f, u] = gain[best, np.arange(gain.shape[1])]
        return gains

    def start(self, targets: Targets, use: int, base: Fit, count: int = 3) -> np.ndarray:
        """(count, P + q) starts for a full fit of a use: its best directions, linear steps of the base included."""
        alpha, score, nuisances, slope = self.solve(targets, np.arange(len(self.sets)))
        mine = np.nonzero(self.directions.use == use)[0]
        best = mine[np.argsort(-score[mine, 0])][:count]
        starts = []
        for k in best:
            shift = (nuisances[:, 0] - slope[:, k] * alpha[k, 0])[: self.base_count]
            unit = np.clip(base.unit + np.clip(shift, -0.3, 0.3), 0.02, 0.98)
            size = float(alpha[k, 0])
            own = self._sized(use, self.directions.unit[k], np.copysign(max(abs(size), 0.2), size))
            starts.append(np.concatenate([unit, own]))
        return np.array(starts)

    def sized(self, targets: Targets, use: int, sizes: Sequence[float], count: int) -> np.ndarray:
        """(n, q) an effect's own parameters at some sizes (of its range) along its best directions."""
        alpha, score, _, _ = self.solve(targets, np.arange(len(self.sets)))
        mine = np.nonzero(self.directions.use == use)[0]
        points = []
        for k in mine[np.argsort(-score[mine, 0])][:count]:
            unit = self._sized(use, self.directions.unit[k], 1.0) - self._sized(use, self.directions.unit[k], 0.0)
            length = max(float(np.max(np.abs(unit))), 1e-6)
            sign = -1.0 if alpha[k, 0] < 0 else 1.0
            points += [self._sized(use, self.directions.unit[k], sign * size / length) for size in sizes]
        return np.unique(np.round(points, 6), axis=0)

    def _sized(self, use: int, point: np.ndarray, alpha: float) -> np.ndarray:
        model = self.directions.models[use]
        own = model.parameters[self.base_count :]
        null = np.array(
            [float(p.to_unit(p.null)) if p.null is not None else v for p, v in zip(own, point, strict=True)]
        )
        return np.clip(null + alpha * (point - null), 0.0, 1.0)

    def likeness(self, a: int, b: int, targets: Targets) -> float:
        """Cosine between the best directions of two uses, base parameters and nuisances profiled out."""
        score = self.solve(targets, np.arange(len(self.sets)))[1][:, 0]
        ks = [max(np.nonzero(self.directions.use == u)[0], key=lambda k: score[k]) for u in (a, b)]
        m = self.moments
        inverse = np.linalg.inv(m.nn.sum(axis=0) + np.diag(m.prior))
        nk = m.nk.sum(axis=0)[:, ks]
        both = np.einsum("asi,bsi,si->ab", self.change[ks], self.change[ks], self.precision, optimize=True)
        profiled = both - nk.T @ inverse @ nk
        return float(profiled[0, 1] / np.sqrt(max(profiled[0, 0] * profiled[1, 1], 1e-12)))
