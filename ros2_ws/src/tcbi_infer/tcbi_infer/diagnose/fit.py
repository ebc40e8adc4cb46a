"""Robust Gauss-Newton in unit space: every trial vector of a step is one batch of simulations.

Where a foot may stick or slip, a prediction hardly depends smoothly on the parameters. So slopes are those of
a straight line through simulations far around, and a sample whose prediction departs from it counts less in the step.
Scatter between joints of the same make is real but is no missing effect: it enters as linear nuisances with a prior.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_infer.diagnose.least_squares import bounded_step, gram
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.slopes import Slopes, unbroken
from tcbi_infer.diagnose.valley import points_along, weakest
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

RADII = (0.12, 0.08)  # of a parameter's range: narrow slopes alone stall where feet stick and slip
MOST = 2  # steps at each
LONGER, SHORTER = 2.0, 0.4  # of the Gauss-Newton step: the longer one where the whole step is good, else the shorter
GOOD = 0.5  # of the fall of the loss that the slopes promise
FOLLOWED = 2  # points along a valley, the best by the slopes, that a fit may go to
RACERS = 2  # far points that are fitted a little on few sets before one is chosen
RACE = (0.08, 0.05)  # radii of these fits
FINALISTS = 3  # of many starts
FEW_SETS = 2  # that choose them
ROUGH_STEP = 0.01  # s at most, of the simulations that do
SLOPES_STRETCH = 2.5  # times a fit's time step, of the simulations that tell its slopes
SMALL_STEP = 0.005  # of a range: the last step of a converged fit
SMALL_GAIN = 0.5  # nats
SMALL_SHARE = 0.003  # of the loss
CLOSE_RADII = (0.07, 0.03)  # with fine steps; a straight line over more than the last bends where nothing slips
ROUNDS = 8  # steps at each: nearly all stay within six
REWEIGHTED = 2  # times, as nuisances follow a trial with heavy tails


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """Deviations that every robot has and no verdict should name, linear, with unit prior variance.

    Attributes:
      effect: (S, T, C, Q) change of the prediction for one prior standard deviation of each.
      names: (Q).
      at: (P,) unit vector of the fit around which it is linear, of the base model or with an effect after it.
    """

    effect: np.ndarray
    names: tuple[str, ...]
    at: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))

    @staticmethod
    def none(problem: Problem) -> "Nuisance":
        """No nuisances."""
        return Nuisance(np.zeros((*problem.observed.shape, 0)), ())


@dataclasses.dataclass(frozen=True)
class Fit:
    """A model's parameters that explain the open sets best.

    Attributes:
      unit: (P,) parameters in [0, 1].
      scatter: the nuisances that it allows for; `nuisance` (Q,) their values in prior standard deviations.
      residual: (S, T, C) of all sets that were simulated (zero elsewhere), nuisances taken out.
      loss: (S,) of each set.
      scale: (G,).
      normal: (S, P + Q, P + Q), `slope` (S, P + Q) and `square` (S,): the quadratic around the optimum, set by set.
      jacobian: (S, T, C, P) slopes of the prediction; `bend` (S, T, C) its departure from them within a step.
      converged: the last step was small, or gained nothing, and no set diverges.
    """

    model: Model
    unit: np.ndarray
    scatter: Nuisance
    nuisance: np.ndarray
    predicted: np.ndarray
    residual: np.ndarray
    loss: np.ndarray
    scale: np.ndarray
    normal: np.ndarray
    slope: np.ndarray
    square: np.ndarray
    jacobian: np.ndarray
    bend: np.ndarray
    converged: bool

    @property
    def parameters(self) -> np.ndarray:
        """(P,) in physical units."""
        return self.model.from_unit(self.unit)

    @property
    def total(self) -> float:
        """Loss of the open sets and of the nuisances' prior."""
        return float(self.loss.sum() + 0.5 * self.nuisance @ self.nuisance)


@dataclasses.dataclass(frozen=True)
class Trial:
    """Where a step might end: (P,) parameters, (Q,) nuisances, the prediction without these, the loss."""

    unit: np.ndarray
    nuisance: np.ndarray
    predicted: np.ndarray
    total: float


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a fit stands: (P,) parameters, (Q,) nuisances, the prediction without these, residual and scales with."""

    unit: np.ndarray
    nuisance: np.ndarray
    predicted: np.ndarray
    residual: np.ndarray
    scale: np.ndarray


def slopes_step(problem: Problem, timestep: float) -> float:
    """Time step (s) of simulations that only tell how a prediction changes, beside a fit with another step.

    Longer for a robot on feet: where these stick and slip, slopes differ no more from one step to the other than from
    one place to the next.
    """
    if not load_rig(problem.replay.rig).floating:
        return timestep
    return max(timestep, min(ROUGH_STEP, SLOPES_STRETCH * timestep))


class Fitter:
    """Fits models of one structure to the open sets of a problem."""

    def __init__(self, problem: Problem, model: Model, scatter: Nuisance, sets: np.ndarray, timestep: float) -> None:
        self.problem, self.model, self.scatter, self.timestep = problem, model, scatter, timestep
        self.sets = np.asarray(sets, int)

    @property
    def slopes_step(self) -> float:
        """Time step (s) of the simulations that tell slopes."""
        return slopes_step(self.problem, self.timestep)

    def few_positions(self) -> np.ndarray:
        """Positions of a few open sets that stand for all in a first fit."""
        return np.unique(np.linspace(0, len(self.sets) - 1, FEW_SETS).astype(int))

    def on_few_sets(self, timestep: float = 0.0) -> "Fitter":
        """A fitter of these alone, with rough time steps or those given (s): it says where to go on, and no more."""
        step = timestep or max(self.timestep, ROUGH_STEP)
        return Fitter(self.problem, self.model, self.scatter, self.sets[self.few_positions()], step)

    def predict(self, unit: np.ndarray) -> np.ndarray:
        """(N, P) unit vectors -> (N, open sets, T, C)."""
        return self._predicted(unit, self.timestep)

    def predict_for_slopes(self, unit: np.ndarray) -> np.ndarray:
        """The same with the time step of slopes."""
        return self._predicted(unit, self.slopes_step)

    def _predicted(self, unit: np.ndarray, timestep: float) -> np.ndarray:
        values = self.model.from_unit(np.atleast_2d(unit))
        return self.problem.replay.predict(self.model, values, list(self.sets), timestep)

    def residual(self, predicted: np.ndarray, nuisance: np.ndarray) -> np.ndarray:
        """(..., open sets, T, C) with the nuisances taken out."""
        return self.problem.residual(predicted + self.scatter.effect[self.sets] @ nuisance, self.sets)

    def scales(self, residual: np.ndarray) -> np.ndarray:
        """(G,) scales of a residual of the open sets."""
        full = np.zeros_like(self.problem.observed)
        full[self.sets] = residual
        return self.problem.scales(full, self.sets[unbroken(residual)])

    def best_start(self, starts: np.ndarray, nuisance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The best of (N, P) starting points by the scale-free loss, and its prediction (open sets, T, C).

        Of many starts only a few go on to all sets; a few sets tell which.
        """
        if len(starts) > 2 * FINALISTS and len(self.sets) > FEW_SETS:
            few = self.on_few_sets()
            totals = few.start_losses(few.predict(starts), nuisance)
            starts = np.asarray(starts)[np.argsort(totals)[:FINALISTS]]
        predicted = self.predict(starts)
        best = int(np.argmin(self.start_losses(predicted, nuisance)))
        return np.asarray(starts[best], float), predicted[best]

    def profiled(self, predicted: np.ndarray, delta: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """(Q,) nuisances that suit one prediction best, so that no trial is judged with those of another.

        Args:
          predicted: (open sets, T, C) without nuisances.
          delta: (Q,) to start from.
          scale: (G,).
        """
        effect = self.scatter.effect[self.sets]
        if not len(delta) or not np.isfinite(predicted).all():
            return delta
        target = self.problem.residual(predicted, self.sets)
        full = np.zeros_like(self.problem.observed)
        for _ in range(REWEIGHTED):
            full[self.sets] = target - effect @ delta
            normal, slope = gram(effect, target, self.problem.precision(full, scale)[self.sets])
            delta = np.linalg.solve(normal.sum(axis=0) + np.eye(len(delta)), slope.sum(axis=0))
        return delta

    def start_losses(self, predicted: np.ndarray, nuisance: np.ndarray) -> list[float]:
        """Loss of each prediction (N, open sets, T, C) at its own scales."""
        totals: list[float] = []
        for each in predicted:
            residual = self.residual(each, nuisance)
            if not np.isfinite(residual).all():
                totals.append(np.inf)
                continue
            totals.append(float(self.problem.loss(residual, self.scales(residual), self.sets).sum()))
        return totals

    def run(
        self,
        starts: np.ndarray,
        nuisance: np.ndarray | None = None,
        radii: Sequence[float] = RADII,
        most: int = MOST,
        valleys: bool = True,
    ) -> Fit:
        """Fits from the best of (N, P) starting points, until the loss stays at the last radius.

        Args:
          starts: (N, P) in [0, 1].
          nuisance: (Q,) to start from.
          radii: of a parameter's range, one after the other: how far around a place simulations tell its slopes.
          most: steps at each radius; fewer if the loss stays.
          valleys: look far along the direction that the data tell worst, between one radius and the next.
        """
        delta = np.zeros(self.scatter.effect.shape[-1]) if nuisance is None else nuisance.copy()
        unit, predicted = self.best_start(starts, delta)
        place = self.place(unit, delta, predicted)
        slopes = Slopes(self.predict_for_slopes)
        self._remember(slopes, [unit], [predicted])
        jacobian, bend = np.zeros((*place.residual.shape, len(unit))), np.zeros_like(place.residual)
        converged = False
        for number, radius in enumerate(radii):
            if valleys and number > 0:
                place = self._along_the_valley(place, jacobian, bend, slopes)
            for _ in range(most):
                jacobian, bend = slopes.at(place.unit, self.for_slopes(place), radius)
                before, tried = self._stepped(place, jacobian, bend)
                self._remember(slopes, [t.unit for t in tried], [t.predicted for t in tried])
                best = min(tried, key=lambda t: t.total)
                moved = float(np.max(np.abs(best.unit - place.unit)))
                fell = before - best.total if best.total < before else 0.0
                if fell > 0.0:
                    place = self.place(best.unit, best.nuisance, best.predicted)
                stays = moved < SMALL_STEP or fell < max(SMALL_GAIN, SMALL_SHARE * abs(before))
                converged = min(before, best.total) < np.inf and stays
                if converged:
                    break
        return self._finish(place, jacobian, bend, converged)

    def _remember(self, slopes: Slopes, units: Sequence[np.ndarray], predicted: Sequence[np.ndarray]) -> None:
        """Let slopes know of simulations that were made for something else, if they are of the same time step."""
        if self.slopes_step == self.timestep:
            slopes.remember(np.asarray(units), np.asarray(predicted))

    def for_slopes(self, place: Place | Trial) -> np.ndarray:
        """(open sets, T, C) the prediction at a place, with the time step of slopes."""
        same = self.slopes_step == self.timestep
        return place.predicted if same else self.predict_for_slopes(place.unit)[0]

    def place(self, unit: np.ndarray, nuisance: np.ndarray, predicted: np.ndarray) -> Place:
        residual = self.residual(predicted, nuisance)
        return Place(unit, nuisance, predicted, residual, self.scales(residual))

    def _stepped(self, place: Place, jacobian: np.ndarray, bend: np.ndarray) -> tuple[float, list[Trial]]:
        """The loss at a place, and two trials of a Gauss-Newton step from there: the whole one and another.

        That is longer where the loss falls as the slopes promise (these count less where they bend, so steps are
        short), and shorter where it does not.
        """
        before = self.total(place.residual, place.nuisance, place.scale)
        normal, slope = self.quadratic(place.residual, place.scale, jacobian, bend)
        step = bounded_step(normal.sum(axis=0), slope.sum(axis=0), place.unit, place.nuisance)
        move, move_delta = step[: len(place.unit)], step[len(place.unit) :]
        left = place.residual - jacobian @ move - self.scatter.effect[self.sets] @ move_delta
        expected = before - self.total(left, place.nuisance + move_delta, place.scale)

        def trial(share: float) -> Trial:
            end = np.clip(place.unit + share * move, 0.0, 1.0)
            return self.trials(end[None], place.nuisance + share * move_delta, place.scale)[0]

        whole = trial(1.0)
        return before, [whole, trial(LONGER if before - whole.total > GOOD * expected else SHORTER)]

    def _along_the_valley(self, place: Place, jacobian: np.ndarray, bend: np.ndarray, slopes: Slopes) -> Place:
        """The best place far along the direction that the data tell worst; the present one if none is better.

        A far point's loss is mostly that of its distance from the valley's floor, so a Gauss-Newton step across the
        valley is made from each, with the slopes known here: what is then expected to be left ranks them.
        """
        count = len(place.unit)
        normal, _ = self.quadratic(place.residual, place.scale, jacobian, bend)
        floor = weakest(normal.sum(axis=0), count)
        wall = np.zeros_like(normal[0])
        wall[:count, :count] = np.trace(normal.sum(axis=0)) * np.outer(floor, floor)  # keeps a step from going back
        units = points_along(self.model, place.unit, floor)
        if not len(units):  # it ends here, at a bound
            return place
        ends: list[tuple[float, np.ndarray]] = []
        trials = self.trials(units, place.nuisance, place.scale)
        for t in trials:
            if t.total < np.inf:
                residual = self.residual(t.predicted, t.nuisance)
                matrix, slope = self.quadratic(residual, place.scale, jacobian, bend)
                step = bounded_step(matrix.sum(axis=0) + wall, slope.sum(axis=0), t.unit, t.nuisance)
                left = residual - jacobian @ step[:count] - self.scatter.effect[self.sets] @ step[count:]
                ends.append((self.total(left, t.nuisance + step[count:], place.scale), t.unit + step[:count]))
        before = self.total(place.residual, place.nuisance, place.scale)
        followed = [
            np.clip(end, 0.0, 1.0) for left, end in sorted(ends, key=lambda e: e[0])[:FOLLOWED] if left < before
        ]
        if followed:
            trials += self.trials(np.array(followed), place.nuisance, place.scale)
        self._remember(slopes, [t.unit for t in trials], [t.predicted for t in trials])
        best = min(trials, key=lambda t: t.total)
        return self.place(best.unit, best.nuisance, best.predicted) if best.total < before else place

    def trials(self, units: np.ndarray, delta: np.ndarray, scale: np.ndarray) -> list[Trial]:
        """Each of (N, P) places, with the nuisances that suit it best."""
        trials = []
        for unit, predicted in zip(units, self.predict(units), strict=True):
            own = self.profiled(predicted, delta, scale)
            trials.append(Trial(unit, own, predicted, self.total(self.residual(predicted, own), own, scale)))
        return trials

    def polish(self, fit: Fit) -> Fit:
        """A fit at another time step carried on at this one."""
        return self.run(fit.unit[None], fit.nuisance, CLOSE_RADII, ROUNDS, valleys=False)

    def total(self, residual: np.ndarray, delta: np.ndarray, scale: np.ndarray) -> float:
        return float(self.problem.loss(residual, scale, self.sets).sum() + 0.5 * delta @ delta)

    def precision(self, residual: np.ndarray, scale: np.ndarray, bend: np.ndarray) -> np.ndarray:
        """(open sets, T, C) weight of each squared residual in a Gauss-Newton step; none of a set that diverges."""
        full = np.zeros_like(self.problem.observed)
        alive = unbroken(residual)
        full[self.sets[alive]] = residual[alive]
        sigma = self.problem.floor * scale[self.problem.group]
        return alive[:, None, None] * self.problem.precision(full, scale)[self.sets] / (1.0 + (bend / sigma) ** 2)

    def quadratic(
        self, residual: np.ndarray, scale: np.ndarray, jacobian: np.ndarray, bend: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(open sets, K, K) normal matrices and (open sets, K) slopes of parameters and nuisances."""
        design = np.concatenate([jacobian, self.scatter.effect[self.sets]], axis=-1)
        return gram(design, np.nan_to_num(residual), self.precision(residual, scale, bend))

    def _finish(self, place: Place, jacobian: np.ndarray, bend: np.ndarray, converged: bool) -> Fit:
        residual, scale = place.residual, place.scale
        normal, slope = self.quadratic(residual, scale, jacobian, bend)
        square = (self.precision(residual, scale, bend) * np.nan_to_num(residual) ** 2).sum(axis=(1, 2))
        return Fit(
            self.model,
            place.unit,
            self.scatter,
            place.nuisance,
            place.predicted,
            residual,
            self.problem.loss(residual, scale, self.sets),
            scale,
            normal,
            slope,
            square,
            jacobian,
            bend,
            converged,
        )
