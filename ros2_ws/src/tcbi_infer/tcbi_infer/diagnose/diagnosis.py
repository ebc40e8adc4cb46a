"""The diagnosis from end to end: fit the base model, screen every effect, fit the best, judge them on held-out motions.

diagnosis = diagnose(model, measurements)
diagnosis.verdict, diagnosis.statement, diagnosis.ranking[0].parameters
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.noise import NoiseFloor, noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Split, split
from tcbi_infer.diagnose import excitation
from tcbi_infer.diagnose.detectable import Background, detectable_sizes
from tcbi_infer.diagnose.evidence import CANNOT_TELL, DetectableSize, Diagnosis, Evidence, NextMotion
from tcbi_infer.diagnose.false_alarms import false_alarms
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance, to_unit
from tcbi_infer.diagnose.judge import Judge, Judged, screened
from tcbi_infer.diagnose.motions import ready_motions
from tcbi_infer.diagnose.null import Null, simulate_null
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.scatter import joint_scatter
from tcbi_infer.diagnose.screen import Directions, Screen, Targets, simulate_directions
from tcbi_infer.diagnose.starts import start_points
from tcbi_infer.diagnose.verdict import MOSTLY, WELL_PREDICTED, Ruling, accept, ranked, rule
from tcbi_sim.effect import EffectUse
from tcbi_sim.effects import candidates
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

CLOSE_STEPS = (0.05, 0.05, 0.03, 0.03, 0.03)  # of finite differences; a fit that has converged ends before
RIVAL_SIZES = (0.08, 0.16, 0.3, 0.5)  # of an effect's range
RIVAL = 1 / 2  # of what the best effect explains of a few sets: one that explains as much in its place is worth a fit
LEAST_WORTH = 10.0  # nats: who explains less has no rivals to look for
HOPELESS = 0.2  # of the best candidate's gain: one that gains less with coarse steps gets no fine ones
GRID = (0.15, 0.5, 0.85)  # of each base parameter's range
Progress = Callable[[str, float], None]  # stage, share done


@dataclasses.dataclass(frozen=True)
class Settings:
    """How thorough a diagnosis is."""

    refine: int = 3  # candidates that get a full fit
    per_effect: int = 2  # sites of one effect among them
    further: int = 8  # other effects that are looked at far from the base fit, where much is left unexplained
    escape: bool = True  # the best candidate's fit, too, looks for other valleys of the loss
    rivals: bool = True  # effects that the screening did not rank are tried in the best one's place
    least_share: float | None = None  # of the best candidate's gain in screening, that a full fit takes; None: any
    timestep: float = 0.002  # s, of the final fits
    coarse: float = 0.005  # s, of the screening and of first fits
    seed: int = 0
    likeness: float = 0.97  # cosine above which two candidates' signatures count as the same
    per_joint: bool = True  # try effects at every single joint
    sealed_share: float = 0.2  # of the kinds of motion, opened at the very end


QUICK = Settings(
    refine=2, least_share=0.4, escape=False, per_joint=False, sealed_share=0.0
)  # a first answer, from few motions


def diagnose(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    uses: Sequence[str] | None = None,
    settings: Settings | None = None,
    progress: Progress | None = None,
    show: Sequence[str] = (),
) -> Diagnosis:
    """Finds the physical effect that a model lacks.

    Args:
      model: the base model; its parameters are fitted again.
      measurements: rollouts, several kinds of motion, each recorded twice at best.
      uses: candidate effects, "name" or "name:site"; the whole library by default.
      settings: how thorough.
      progress: called with the stage and the share done.
      show: candidates of which to say which motion would show them best.

    Raises:
      CompareError: nothing to compare, or another rig's rollouts.
    """
    quiet: Progress = lambda stage, share: None  # noqa: E731
    return _Run(model, measurements, uses, settings or Settings(), progress or quiet, show).go()


def library(model: Model) -> list[EffectUse]:
    """Every use of every effect that the model has not got yet."""
    return [u for u in candidates(load_rig(model.rig)) if u.key not in model.effects]


def tried(model: Model, settings: Settings) -> list[str]:
    """The uses that a diagnosis tries where none are named."""
    single = () if settings.per_joint else load_rig(model.rig).joint_names
    return [u.key for u in library(model) if u.site not in single]


def find_candidates(model: Model, wanted: Sequence[str]) -> list[str]:
    """The uses that effects' names ("weak_leg", at all its sites) or single uses ("weak_leg:lf") stand for.

    Raises:
      UnknownNameError: one of them is none, or is in the model already.
    """
    every = library(model)
    known = dict.fromkeys([u.effect.name for u in every] + [u.key for u in every])
    for name in wanted:
        if name not in known:
            raise UnknownNameError(f"candidate for {model.version}", name, tuple(known))
    return [u.key for u in every if u.key in wanted or u.effect.name in wanted]


class _Run:
    """One diagnosis; each method is a stage."""

    def __init__(
        self,
        model: Model,
        measurements: Sequence[Measurement],
        uses: Sequence[str] | None,
        settings: Settings,
        progress: Progress,
        show: Sequence[str],
    ) -> None:
        self.began, self.show = time.perf_counter(), show
        self.model, self.settings, self.progress = model, settings, progress
        self.measurements = measurements
        self.replay = Replay.of(model, measurements)
        self.split: Split = split(self.replay.replicates, settings.seed, settings.sealed_share)
        self.sets = np.array(self.split.open, int)
        self.uses = list(uses) if uses is not None else tried(model, settings)
        self.floor = self._floor(model)
        self.problem = Problem.of(self.replay, self.floor.values)

    def _floor(self, model: Model) -> NoiseFloor:
        predicted = self.replay.predict(model, model.mean()[None], timestep=self.settings.coarse)
        residual = self.replay.measured - self.replay.by_rollout(predicted[0])
        return noise_floor(self.replay.layout, self.replay.measured, residual, self.replay.replicates)

    def go(self) -> Diagnosis:
        """All stages in order."""
        coarse, nuisance = self.fit_base()
        base = self._refit(coarse, nuisance)  # what a coarse time step gets wrong must not look like an effect
        self.progress("screening effects", 0.25)
        directions = simulate_directions(
            self.problem,
            base,
            nuisance,
            self.uses,
            self.sets,
            self.settings.coarse,
            self._screened(),
        )
        judge = Judge(self.model, self.problem, self.split, self.floor, nuisance, self.settings.timestep)
        before = judge.judge(base)
        if not directions.uses:
            return self._conclude(judge, before, self._drift(coarse, base), [], {}, Null.of_no_search(), directions)
        screen = Screen(self.problem, base, nuisance, directions, self.sets)
        data = screen.targets(base.residual[None])
        gains = screen.held_out(data)[:, :, 0]
        chosen = self._choose(directions, gains)
        fits = self._fit_chosen(chosen, screen, data, base, nuisance)
        rivals = self._rivals(screen, data, base, nuisance, fits)
        fits |= self._fit_chosen(rivals, screen, data, base, nuisance, (0.7, 0.75))
        after = {u: judge.judge(fine) for u, (_, fine) in fits.items()}
        least = min(e.error for e in (before, *after.values()))
        if least > WELL_PREDICTED and before.error - least < MOSTLY * (before.error - 1.0):
            hidden = self._hidden(screen, data, gains, base, nuisance, fits)
            others = self._fit_chosen(hidden, screen, data, base, nuisance, (0.8, 0.85))
            fits |= others
            after |= {u: judge.judge(fine) for u, (_, fine) in others.items()}
        self.progress("simulating nothing missing", 0.85)
        leftover = min([base, *[fine for _, fine in fits.values()]], key=lambda f: f.total).residual
        null = simulate_null(
            self.problem, screen, nuisance, leftover, self.sets, np.random.default_rng(self.settings.seed)
        )
        alike = self._alike(screen, data, list(fits))
        evidence = [
            screened(use, gains[:, u], screen.sizes, before.error)
            for u, use in enumerate(directions.uses)
            if u not in fits
        ]
        for u, (rough, fine) in fits.items():
            use = directions.uses[u]
            evidence.append(judge.evidence(use, after[u], before, self._drift(rough, fine)))
        judged = []
        for e in evidence:
            accepted, reason = accept(e, null.threshold, judge.unfitted)
            judged.append(dataclasses.replace(e, accepted=accepted, reason=reason, alike=alike.get(e.use, ())))
        background = Background.of(null, min(e.error for e in (before, *after.values())), leftover)
        detectable = detectable_sizes(self.problem, screen, background)
        drift = self._drift(coarse, base)
        named = {directions.uses[u]: e for u, e in after.items()}
        return self._conclude(judge, before, drift, ranked(judged), named, null, directions, detectable)

    def fit_base(self) -> tuple[Fit, Nuisance]:
        """The base model's parameters from a grid of starts, then again with scatter between joints allowed for."""
        self.progress("fitting the base model", 0.0)
        none = Nuisance.none(self.problem)
        width = len(self.model.parameters)
        levels = GRID if width <= 4 else (0.3, 0.7)
        grid = np.array(list(itertools.islice(itertools.product(levels, repeat=width), 128)))
        nominal = np.array([p.nominal for p in self.model.parameters])
        known = np.array([to_unit(self.model, self.model.mean()), to_unit(self.model, nominal)])
        starts = np.concatenate([known, grid])
        everything = Fitter(self.problem, self.model, none, self.sets, self.settings.coarse)
        near = everything.on_few_sets().run(starts, steps=(0.12, 0.1, 0.08, 0.06))
        first = everything.run(np.concatenate([near.unit[None], known]), steps=(0.06,))
        self.problem = self.problem.with_autocorrelation(self._full(first.residual))
        self.progress("fitting the base model", 0.12)
        nuisance = joint_scatter(self.problem, first, self.sets, self.settings.coarse)
        again = Fitter(self.problem, self.model, nuisance, self.sets, self.settings.coarse)
        fit = again.run(first.unit[None], steps=CLOSE_STEPS)
        fit = again.escape(fit, width, CLOSE_STEPS)
        self.base_loss = fit.total
        return fit, nuisance

    def _full(self, residual: np.ndarray) -> np.ndarray:
        full = np.zeros_like(self.problem.observed)
        full[self.sets] = residual
        return full

    def _refit(self, fit: Fit, nuisance: Nuisance) -> Fit:
        if self.settings.timestep >= self.settings.coarse:
            return fit
        return Fitter(self.problem, fit.model, nuisance, self.sets, self.settings.timestep).polish(fit)

    def _screened(self) -> Callable[[str], None]:
        count = itertools.count(1)
        return lambda use: self.progress(f"screening {use}", 0.25 + 0.3 * next(count) / len(self.uses))

    def _choose(self, directions: Directions, gains: np.ndarray) -> list[int]:
        """Uses that get a full fit: the best by screening, at most a few sites of one effect."""
        mean = gains.mean(axis=0)
        least = -np.inf if self.settings.least_share is None else self.settings.least_share * float(np.max(mean))
        order = [u for u in np.argsort(-mean) if mean[u] >= least]
        chosen: list[int] = []
        per_effect: dict[str, int] = {}
        for u in order:
            name = directions.uses[u].partition(":")[0]
            if per_effect.get(name, 0) < self.settings.per_effect and len(chosen) < self.settings.refine:
                chosen.append(int(u))
                per_effect[name] = per_effect.get(name, 0) + 1
        return chosen

    def _hidden(
        self,
        screen: Screen,
        data: Targets,
        gains: np.ndarray,
        base: Fit,
        nuisance: Nuisance,
        fits: Collection[int],
    ) -> list[int]:
        """Uses of other effects that start well far from the base fit, where what was fitted leaves too much.

        A base fit that bent itself to make up for an effect hides it from the screening, which looks along straight
        lines from there: soft servos and half the weight passed for grease once.
        """
        names = screen.directions.uses
        seen = {names[u].partition(":")[0] for u in fits}
        losses: dict[int, float] = {}
        for u in map(int, np.argsort(-gains.mean(axis=0))):
            name = names[u].partition(":")[0]
            if name in seen or len(losses) == self.settings.further:
                continue
            seen.add(name)
            self.progress(f"looking for {names[u]} elsewhere", 0.75)
            fitter = Fitter(self.problem, screen.directions.models[u], nuisance, self.sets, self.settings.coarse)
            few = fitter.on_few_sets()
            starts = start_points(screen, data, u, base, fitter)
            losses[u] = min(few.start_losses(few.predict(starts), np.zeros(nuisance.effect.shape[-1])))
        return sorted(losses, key=lambda u: losses[u])[: self.settings.per_effect]

    def _rivals(
        self, screen: Screen, data: Targets, base: Fit, nuisance: Nuisance, fits: dict[int, tuple[Fit, Fit]]
    ) -> dict[int, np.ndarray]:
        """Uses that hardly show around the base fit, but nearly take the best effect's place with its base parameters.

        A base fit that answered late because its servos were soft hid one kind of latency and not the other.

        Returns:
          Uses, each with the (1, P) start that explains most.
        """
        if not (fits and self.settings.rivals):
            return {}
        best = min((rough for rough, _ in fits.values()), key=lambda f: f.total)
        known = best.unit[: len(base.unit)]
        whole = Fitter(self.problem, base.model, nuisance, self.sets, self.settings.coarse)
        few, positions = whole.on_few_sets(), whole.few_positions()
        (without,) = few.start_losses(few.predict(known), best.nuisance)
        worth = without - float(best.loss[positions].sum())
        if worth < LEAST_WORTH:
            return {}
        explained: dict[int, tuple[float, np.ndarray]] = {}
        for u, model in enumerate(screen.directions.models):
            if u in fits:
                continue
            few = Fitter(self.problem, model, nuisance, self.sets, self.settings.coarse).on_few_sets()
            sizes = screen.sized(data, u, RIVAL_SIZES, 1)
            starts = np.concatenate([np.repeat(known[None], len(sizes), axis=0), sizes], axis=1)
            losses = few.start_losses(few.predict(starts), best.nuisance)
            i = int(np.argmin(losses))
            if without - losses[i] > RIVAL * worth:
                explained[u] = losses[i], starts[i][None]
        nearest = sorted(explained, key=lambda u: explained[u][0])[: self.settings.per_effect]
        return {u: explained[u][1] for u in nearest}

    def _fit_chosen(
        self,
        chosen: Collection[int] | Mapping[int, np.ndarray],
        screen: Screen,
        data: Targets,
        base: Fit,
        nuisance: Nuisance,
        shares: tuple[float, float] = (0.55, 0.75),
    ) -> dict[int, tuple[Fit, Fit]]:
        begin, end = shares
        fitted: dict[int, tuple[Fitter, Fit]] = {}
        for i, u in enumerate(chosen):
            model = screen.directions.models[u]
            self.progress(f"fitting {screen.directions.uses[u]}", begin + (end - begin) * i / len(chosen))
            fitter = Fitter(self.problem, model, nuisance, self.sets, self.settings.coarse)
            starts = start_points(screen, data, u, base, fitter)
            if isinstance(chosen, Mapping):
                starts = np.concatenate([chosen[u], starts])
            fitted[u] = fitter, fitter.run(starts, steps=CLOSE_STEPS)
        if self.settings.escape and fitted:
            u = min(fitted, key=lambda u: fitted[u][1].total)
            fitter, rough = fitted[u]
            fitted[u] = fitter, fitter.escape(rough, len(base.unit), CLOSE_STEPS)
        gains = {u: self.base_loss - rough.total for u, (_, rough) in fitted.items()}
        best = max(gains.values(), default=0.0)
        least = min(HOPELESS * best, best)
        return {u: (rough, self._refit(rough, nuisance)) for u, (_, rough) in fitted.items() if gains[u] >= least}

    def _alike(self, screen: Screen, data: Targets, chosen: Sequence[int]) -> dict[str, tuple[str, ...]]:
        names = screen.directions.uses
        return {
            names[a]: tuple(
                names[b] for b in chosen if b != a and abs(screen.likeness(a, b, data)) > self.settings.likeness
            )
            for a in chosen
        }

    def _drift(self, coarse: Fit, fine: Fit) -> np.ndarray:
        """(P,) how far the optimum may still move below the fine time step, from how far it moved down to it."""
        rest = self.settings.timestep / max(self.settings.coarse - self.settings.timestep, self.settings.timestep)
        return rest * np.abs(fine.unit - coarse.unit)

    def _conclude(
        self,
        judge: Judge,
        before: Judged,
        drift: np.ndarray,
        ranking: list[Evidence],
        after: dict[str, Judged],
        null: Null,
        directions: Directions,
        detectable: tuple[DetectableSize, ...] = (),
    ) -> Diagnosis:
        """Rule, and put together everything that the verdict rests on."""
        kinds, sealed = len(self.split.folds), judge.sealed
        ruling = rule(ranking, judge.held_out_error(before), kinds, judge.unfitted)
        errors = {"unfitted": judge.unfitted, "base": before.error}
        best = ranking[0] if ranking and ranking[0].refined else None
        if best:
            errors[best.use] = best.error_after
        return Diagnosis(
            model=self.model.version,
            verdict=ruling.verdict,
            effects=tuple(dict.fromkeys(u.partition(":")[0] for u in ruling.uses)),
            uses=ruling.uses,
            statement=ruling.statement,
            ranking=tuple(ranking),
            seconds=time.perf_counter() - self.began,
            rollouts=tuple(m.rollout_id for m in self.replay.measurements),
            sealed=tuple(m.rollout_id for m in sealed),
            threshold=null.threshold,
            errors=errors,
            floor_from_replicates=self.floor.from_replicates,
            untestable=directions.untestable,
            guards=tuple(guard(self.measurements)),
            claims=tuple(self._claims(kinds, sealed, null)),
            base=judge.evidence("", before, before, drift),
            moments=tuple(judge.moments(before, after[best.use])) if best else (),
            false_alarms=false_alarms(null),
            detectable=detectable,
            next_motions=self._next_motions(ruling, before, after, detectable),
        )

    def _next_motions(
        self, ruling: Ruling, before: Judged, after: dict[str, Judged], sizes: Sequence[DetectableSize]
    ) -> tuple[NextMotion, ...]:
        """What to record next, where that is asked for or the rollouts cannot tell."""
        if ruling.verdict != CANNOT_TELL and not self.show:
            return ()
        self.progress("looking for the motion to record next", 0.95)
        motions, timestep = ready_motions(load_rig(self.model.rig), self.replay.measurements), self.settings.coarse
        found: tuple[NextMotion, ...] = ()
        if ruling.verdict == CANNOT_TELL:
            fits = {use: judged.fit for use, judged in after.items()}
            found = excitation.between(self.problem, ruling.uses, before.fit, fits, motions, timestep)
        for use in self.show:
            size = min((s for s in sizes if s.use == use and s.value is not None), key=lambda s: s.share, default=None)
            truth = excitation.planted(before.fit, use, size)
            found += excitation.motions_that_show(self.problem, use, before.fit, truth, motions, timestep)
        return found

    def _claims(self, kinds: int, sealed: Sequence[Measurement], null: Null) -> list[str]:
        if kinds < 2:
            claims = ["Nothing was held out: the errors shown are those on the motion of the fit itself."]
        else:
            stayed = f"; {counted(len(sealed), 'rollout')} stayed sealed until the end" if sealed else ""
            claims = [f"{kinds} kinds of motion were held out in turn{stayed}."]
        if not sealed and kinds >= 2:
            why = "Too few kinds of motion to seal any" if self.settings.sealed_share else "A quick look seals none"
            claims.append(f"{why}: the errors shown are cross-validated.")
        claims.append(false_alarms(null).statement)
        if not self.floor.from_replicates:
            claims.append(self.floor.statement)
        return claims


__all__ = ["QUICK", "Settings", "diagnose"]
