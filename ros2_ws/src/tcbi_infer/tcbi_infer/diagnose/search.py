"""Which effects get a full fit, and these fits: the best by screening, and those that the screening could not see."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.escape import leapt, rescaled, resized
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.scatter import relinearised
from tcbi_infer.diagnose.screen import Screen
from tcbi_infer.diagnose.settings import Settings
from tcbi_infer.diagnose.starts import start_points
from tcbi_sim.effect import EffectUse
from tcbi_sim.model import Model

RIVAL_SIZES = (0.08, 0.16, 0.3, 0.5)  # of an effect's range
RIVAL = 1 / 2  # of what the best effect explains of a few sets: one that explains as much in its place is worth a fit
LEAST_WORTH = 10.0  # nats: who explains less has no rivals to look for
# of the best candidate's gain over the base model's own fit:
HOPELESS = 0.2  # one that starts with less on a few sets, in the best one's place or its own, gets no coarse steps
NO_RIVAL = 1 / 3  # one that gains less with coarse steps gets no fine ones
LOOKING, COARSE, ESCAPE, FINE = (0.0, 0.16), (0.16, 0.44), (0.44, 0.8), (0.8, 1.0)  # shares of these fits' time
Fits = dict[int, tuple[Fit, Fit]]  # of a use, by its number: with coarse and with fine steps
Progress = Callable[[str, float], None]  # stage, share done


@dataclasses.dataclass(frozen=True)
class Search:
    """Fits of candidates to the open sets.

    Attributes:
      base: the base model's fit with fine steps; `base_loss` that with coarse ones.
      gains: (F, U) of each use in each kind of motion, by screening.
      sets: the open ones.
    """

    problem: Problem
    base: Fit
    base_loss: float
    screen: Screen
    gains: np.ndarray
    sets: np.ndarray
    settings: Settings
    progress: Progress

    @property
    def names(self) -> tuple[str, ...]:
        """(U) the uses."""
        return self.screen.directions.uses

    @property
    def worth(self) -> np.ndarray:
        """(U) gain of each use by screening; a kind of motion that went otherwise counts as little as in a verdict."""
        return paired.total(self.gains, self.screen.sizes)[0]

    def best_by_screening(self) -> list[int]:
        """Uses that get a full fit: the best by screening, at most a few sites of one effect."""
        worth = self.worth
        most = float(np.max(worth))
        least = min(self.settings.least_share * most, most)
        order = [u for u in np.argsort(-worth) if worth[u] >= least]
        chosen: list[int] = []
        per_effect: dict[str, int] = {}
        for u in order:
            name = _effect(self.names[u])
            if per_effect.get(name, 0) < self.settings.per_effect and len(chosen) < self.settings.refine:
                chosen.append(int(u))
                per_effect[name] = per_effect.get(name, 0) + 1
        return chosen

    def elsewhere(self, fits: Fits) -> Fits:
        """The best candidate's fit in another valley of the loss, if it is better: looked for here, if not always."""
        if self.settings.escape or not fits:
            return {}
        u = min(fits, key=lambda u: fits[u][0].total)
        self.progress(f"fitting {self.names[u]} elsewhere", 0.95)
        rough, fine = fits[u]
        other = self._escaped(rough)
        found = fine if other is rough else refined(self.problem, other, self.sets, self.settings)
        return {u: (other, found)} if found.total < fine.total else {}

    def hidden(self, fits: Collection[int]) -> dict[int, np.ndarray]:
        """Uses that start well far from the base fit, of other effects and of other places, where too much is left.

        A base fit that bent itself to make up for an effect hides it from the screening, which looks along straight
        lines from there: soft servos and half the weight passed for grease once. Of an effect with several places, the
        one where some size of it leaves least of a few sets.

        Returns:
          Uses, each with (n, P) starts.
        """
        none = np.zeros(len(self.base.nuisance))
        places: dict[str, list[int]] = {}
        for u in map(int, np.argsort(-self.worth)):
            if u not in fits:
                places.setdefault(_effect(self.names[u]), []).append(u)
        losses: dict[int, float] = {}
        starts: dict[int, np.ndarray] = {}
        for name in list(places)[: self.settings.further if self.settings.refine else 0]:
            self.progress(f"looking for {name} elsewhere", 0.95)
            u = min(places[name], key=self._loss_on_few) if len(places[name]) > 1 else places[name][0]
            starts[u] = self._starts(u)
            losses[u] = min(self._losses_on_few(self.screen.directions.models[u], starts[u], none))
        nearest = sorted(losses, key=lambda u: losses[u])[: self.settings.per_effect]
        return {u: starts[u] for u in nearest}

    def rivals(self, fits: Fits) -> dict[int, np.ndarray]:
        """Uses that hardly show around the base fit, but nearly take the best effect's place with its base parameters.

        A base fit that answered late because its servos were soft hid one kind of latency and not the other. What
        happens at one place only is no rival of what happens everywhere, and the scatter of a joint is none where it is
        a nuisance: the leader was fitted with it. A use that was fitted is one again if it starts lower there than its
        own fit ended: the leader may have found a valley that it was never shown.

        Returns:
          Uses, each with the (1, P) start that explains most.
        """
        if not (fits and self.settings.rivals):
            return {}
        leader = min(fits, key=lambda u: fits[u][0].total)
        best, anywhere = fits[leader][0], ":" in self.names[leader]
        known = best.unit[: len(self.base.unit)]
        both = np.array([known, self.base.unit])
        without, own = self._losses_on_few(self.base.model, both, best.nuisance, best.scatter)
        (with_it,) = self._losses_on_few(best.model, best.unit, best.nuisance, best.scatter)
        if without - with_it < LEAST_WORTH:
            return {}
        most = min(own - HOPELESS * max(own - with_it, 0.0), without - RIVAL * (without - with_it))
        scatter = {f"gain_scatter:{joint}" for joint in self.base.scatter.names}
        explained: dict[int, tuple[float, np.ndarray]] = {}
        for u, model in enumerate(self.screen.directions.models):
            if u == leader or (":" in self.names[u] and not anywhere) or self.names[u] in scatter:
                continue
            rough = fits[u][0] if u in fits else None
            own_fit = self._losses_on_few(model, rough.unit, rough.nuisance, rough.scatter) if rough else []
            sizes = self.screen.sized(self.screen.data, u, RIVAL_SIZES, 1)
            starts = np.concatenate([np.repeat(known[None], len(sizes), axis=0), sizes], axis=1)
            losses = self._losses_on_few(model, starts, best.nuisance, best.scatter)
            i = int(np.argmin(losses))
            if losses[i] < min([most, *own_fit]):
                explained[u] = losses[i], starts[i]
        nearest = sorted(explained, key=lambda u: explained[u][0])[: self.settings.per_effect]
        return {u: explained[u][1][None] for u in nearest}

    def fit(
        self, uses: Collection[int] | Mapping[int, np.ndarray], shares: tuple[float, float], others: Fits | None = None
    ) -> Fits:
        """Full fits of some uses, all with coarse steps, those with hope with fine ones.

        Args:
          uses: their numbers; a mapping gives (n, P) starts of each.
          shares: of the whole diagnosis done before and after.
          others: fits so far, of other uses; the best of all says who has hope.
        """

        def told(stage: str, stages: tuple[float, float], share: float) -> None:
            done = stages[0] + share * (stages[1] - stages[0])
            self.progress(stage, shares[0] + done * (shares[1] - shares[0]))

        least_loss = min((rough.total for rough, _ in (others or {}).values()), default=np.inf)
        starts: dict[int, np.ndarray] = {}
        for i, u in enumerate(uses):
            told(f"looking where to fit {self.names[u]}", LOOKING, i / len(uses))
            starts[u] = uses[u] if isinstance(uses, Mapping) else self._starts(u)
        fitted: dict[int, Fit] = {}
        promising = self._promising(starts, others or {})
        for i, u in enumerate(promising):
            told(f"fitting {self.names[u]}", COARSE, i / len(promising))
            fitted[u] = self._fitter(self.screen.directions.models[u]).run(starts[u])
        if fitted:
            u = min(fitted, key=lambda u: fitted[u].total)
            if fitted[u].total <= least_loss:
                told(f"fitting {self.names[u]} in other valleys", ESCAPE, 0.0)
                fitted[u] = rescaled(self._fitter(fitted[u].model), fitted[u])
                fitted[u] = self._escaped(fitted[u]) if self.settings.escape else fitted[u]
        gains = {u: self.base_loss - rough.total for u, rough in fitted.items()}
        best = max([self.base_loss - least_loss, *gains.values()])
        least = min(NO_RIVAL * best, best)
        fine = [u for u in fitted if gains[u] >= least]
        fits: Fits = {}
        for i, u in enumerate(fine):
            told(f"fitting {self.names[u]} with fine steps", FINE, i / len(fine))
            fits[u] = fitted[u], refined(self.problem, fitted[u], self.sets, self.settings)
        if fits:
            u = min(fits, key=lambda u: fits[u][1].total)
            fits[u] = fits[u][0], self._resized(*fits[u])
        return fits

    def _resized(self, rough: Fit, fine: Fit) -> Fit:
        fitter = Fitter(self.problem, fine.model, fine.scatter, self.sets, self.settings.timestep)
        return resized(fitter, fine, rough, len(self.base.unit))

    def _promising(self, starts: Mapping[int, np.ndarray], others: Fits) -> list[int]:
        """Uses whose (n, P) starts explain enough of a few sets to be fitted to all; and the best one by screening, of
        all sets, whatever a few say with rough steps."""
        none = np.zeros(len(self.base.nuisance))
        without = min(self._losses_on_few(self.base.model, self.base.unit, none))

        def gain(model: Model, units: np.ndarray) -> float:
            return without - min(self._losses_on_few(model, units, none))

        gains = {u: gain(self.screen.directions.models[u], units) for u, units in starts.items()}
        best = max([*gains.values(), *(gain(rough.model, rough.unit) for rough, _ in others.values())], default=0.0)
        leads = None if others else max(gains, key=lambda u: self.worth[u], default=None)
        return [u for u, nats in gains.items() if nats >= HOPELESS * best or best < LEAST_WORTH or u == leads]

    def _losses_on_few(
        self, model: Model, units: np.ndarray, nuisance: np.ndarray, scatter: Nuisance | None = None
    ) -> list[float]:
        few = self._fitter(model, scatter).on_few_sets()
        return few.start_losses(few.predict(units), nuisance)

    def _escaped(self, rough: Fit) -> Fit:
        """The best valley around a coarse fit; far from the base model's, the scatter needs slopes of its own there."""
        steps = self.settings.coarse
        here = relinearised(self.problem, rough, self.sets, steps)
        there = leapt(self._fitter(rough.model, here.scatter), here, len(self.base.unit))
        return here if there is here else relinearised(self.problem, there, self.sets, steps)

    def _loss_on_few(self, use: int) -> float:
        """The least that a use leaves of a few sets at some size, beside the base model's fit."""
        sizes = self.screen.sized(self.screen.data, use, RIVAL_SIZES, 1)
        starts = np.concatenate([np.repeat(self.base.unit[None], len(sizes), axis=0), sizes], axis=1)
        return min(self._losses_on_few(self.screen.directions.models[use], starts, np.zeros(len(self.base.nuisance))))

    def alike(self, uses: Sequence[int]) -> dict[str, tuple[str, ...]]:
        """By each use's name, the others that change the signals as it does, or of which one includes the other."""
        return {self.names[a]: tuple(self.names[b] for b in uses if b != a and self._looks_like(a, b)) for a in uses}

    def _looks_like(self, a: int, b: int) -> bool:
        one, other = (self.screen.directions.models[u].uses()[-1] for u in (a, b))
        alike = abs(self.screen.likeness(a, b, self.screen.data)) > self.settings.likeness
        return alike or _includes(one, other) or _includes(other, one)

    def _starts(self, use: int) -> np.ndarray:
        fitter = self._fitter(self.screen.directions.models[use])
        return start_points(self.screen, self.screen.data, use, self.base, fitter)

    def _fitter(self, model: Model, scatter: Nuisance | None = None) -> Fitter:
        """Of a model, with the base model's scatter unless another is given."""
        return Fitter(self.problem, model, scatter or self.base.scatter, self.sets, self.settings.coarse)


def merged(fits: Fits, further: Fits) -> Fits:
    """All of them; of a use that was fitted twice the better fit."""
    return fits | {u: f for u, f in further.items() if u not in fits or f[1].total < fits[u][1].total}


def refined(problem: Problem, fit: Fit, sets: np.ndarray, settings: Settings) -> Fit:
    """A fit carried on with fine steps."""
    if settings.timestep >= settings.coarse:
        return fit
    return Fitter(problem, fit.model, fit.scatter, sets, settings.timestep).polish(fit)


def _includes(richer: EffectUse, plain: EffectUse) -> bool:
    """Whether an effect says that it includes another one, which is at the same place."""
    return plain.effect.name in richer.effect.includes and plain.site == richer.site


def _effect(use: str) -> str:
    return use.partition(":")[0]
