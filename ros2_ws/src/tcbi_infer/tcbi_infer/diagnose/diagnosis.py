"""The diagnosis from end to end: fit the base model, screen every effect, fit the best, judge them on held-out motions.

diagnosis = diagnose(model, measurements)
diagnosis.verdict, diagnosis.statement, diagnosis.ranking[0].parameters
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np

from tcbi_infer.compare.common_lag import LATENCIES, are_latencies, common_lag, without_latency
from tcbi_infer.compare.comparison import without_change
from tcbi_infer.compare.errors import CompareError
from tcbi_infer.compare.guards import IDLE, IDLE_SPAN, guard, idle_parameter, to_mend, unchecked, unchecked_line
from tcbi_infer.compare.noise import NoiseFloor, mean_of
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Split, split
from tcbi_infer.compare.steadiness import overtaken, unsteady
from tcbi_infer.compare.timestep import fine_step
from tcbi_infer.diagnose import excitation
from tcbi_infer.diagnose.agreement import agreement, disagreeing
from tcbi_infer.diagnose.at_random import AT_RANDOM, suspected
from tcbi_infer.diagnose.base_fit import base_starts, better_base, fit_base
from tcbi_infer.diagnose.candidates import tried, untried
from tcbi_infer.diagnose.claims import bounds, claims, left_out, not_simulated
from tcbi_infer.diagnose.detectable import Background, detectable_sizes
from tcbi_infer.diagnose.evidence import (
    CANNOT_TELL,
    EFFECT,
    OUTSIDE_LIBRARY,
    WELL_PREDICTED,
    DetectableSize,
    Diagnosis,
    Evidence,
    NextMotion,
)
from tcbi_infer.diagnose.false_alarms import false_alarms
from tcbi_infer.diagnose.fit import Fit, slopes_step
from tcbi_infer.diagnose.judge import Judge, Judged, screened
from tcbi_infer.diagnose.leftover import explain
from tcbi_infer.diagnose.motions import ready_motions
from tcbi_infer.diagnose.null import Null, simulate_null
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.screen import Directions, Screen, simulate_directions
from tcbi_infer.diagnose.search import Fits, Progress, Search, merged, refined
from tcbi_infer.diagnose.settings import Settings
from tcbi_infer.diagnose.verdict import MOSTLY, Ruling, accept, better_misfit, ranked, rule
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

MEND_FIRST = (
    "These recordings look wrong, and no effect was tried on them: {} Mend that and record again; where it is the "
    "robot after all, --trust-recording searches."
)
DIVERGES = "its simulations diverge"
# shares of a diagnosis done before and after: 90 s of a hexapod's motion and the whole library, the mean of two robots
SCREENING, FITS, RIVALS, HIDDEN = (0.21, 0.42), (0.42, 0.92), (0.92, 0.95), (0.95, 0.96)


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
      show: candidates of which to say which motion would show them best; those that the model has are left out.

    Raises:
      CompareError: nothing to compare, another rig's rollouts, or none in which the model can be simulated.
    """
    quiet: Progress = lambda stage, share: None  # noqa: E731
    return _Run(model, measurements, uses, settings or Settings(), progress or quiet, show).go()


@dataclasses.dataclass(frozen=True)
class _Found:
    """What a search around one fit of the base model brought.

    Attributes:
      coarse, base: the base model's fit with coarse and with fine steps.
      before: that, judged; `after` each candidate, by its number.
      search: None where no candidate shows at all, or none was tried.
    """

    coarse: Fit
    base: Fit
    judge: Judge
    before: Judged
    directions: Directions
    search: Search | None = None
    fits: Fits = dataclasses.field(default_factory=dict)
    after: dict[int, Judged] = dataclasses.field(default_factory=dict)


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
        self.began, self.show = time.perf_counter(), [use for use in show if use not in model.effects]
        self.model, self.settings, self.progress = model, settings, _only_forward(progress)
        self.measurements = measurements
        self.mend = [] if settings.trust_recording else to_mend(measurements)
        self.replay = Replay.of(model, measurements)
        at_mean = self.replay.predict(model, model.mean()[None], timestep=settings.coarse)[0]
        self.split, self.lost = self._without_diverging(np.isnan(at_mean).all(axis=(1, 2)))
        self.sets = np.array(self.split.open, int)
        self.uses = list(uses) if uses is not None else tried(model, settings)
        self.floor: NoiseFloor = self.replay.noise_floor(self.replay.measured - self.replay.by_rollout(at_mean))
        self.problem = Problem.of(self.replay, self.floor.values)

    def _without_diverging(self, at_mean: np.ndarray) -> tuple[Split, tuple[str, ...]]:
        """Which sets are open and which sealed, and a guard on those that diverge wherever a fit could start.

        Args:
          at_mean: (S,) which diverge at the model's mean.
        """
        whole = split(self.replay.replicates, self.settings.seed, self.settings.sealed_share)
        doubtful = [s for s in (*whole.open, *whole.sealed) if at_mean[s]]
        if not doubtful:
            return whole, ()
        starts = self.model.from_unit(base_starts(self.model))
        diverged = self.replay.simulate(self.model, starts, doubtful, self.settings.coarse).diverged.all(axis=0)
        lost = {doubtful[i] for i in np.flatnonzero(diverged)}
        if not lost:
            return whole, ()
        members = (self.replay.replicates[s].members for s in sorted(lost))
        names = [self.replay.measurements[m].rollout_id for m in itertools.chain.from_iterable(members)]
        who = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        folds = [tuple(s for s in fold if s not in lost) for fold in whole.folds]
        if not any(folds):
            raise CompareError(
                f"the simulation of {self.model.version} diverges in every motion, wherever its fit could start "
                f"({who}); begin nearer to the robot (./tcbi infer makes such a version), or record calmer motions"
            )
        told = f"The model's simulation diverges wherever its fit could start: that counts for nothing here ({who})."
        sealed = tuple(s for s in whole.sealed if s not in lost)
        return Split(tuple(fold for fold in folds if fold), sealed), (told,)

    def go(self) -> Diagnosis:
        """All stages in order."""
        self.problem, coarse = fit_base(self.problem, self.model, self.sets, self.settings, self.progress)
        if self.settings.timestep < self.settings.coarse:
            step = fine_step(self.replay, self.model, self.floor.values, list(self.sets), coarse.parameters)
            self.settings = dataclasses.replace(self.settings, timestep=min(self.settings.timestep, step))
        found = self._search(coarse)
        rough = [fit for fit, _ in found.fits.values()]
        if self.mend:
            return self._rule(found)
        better = better_base(self.problem, self.sets, self.settings, coarse, rough, self.progress)
        return self._rule(found if better is None else self._search(better))

    def _search(self, coarse: Fit) -> "_Found":
        """Screen the candidates around the base model's fit, and fit those with hope."""
        # what a coarse time step gets wrong must not look like an effect
        base = refined(self.problem, coarse, self.sets, self.settings)
        self.progress("screening effects", SCREENING[0])
        # with one kind of motion nothing tells candidates apart; one that is asked for alone is fitted all the same
        comparable = (len(self.split.folds) > 1 or len(self.uses) == 1) and not self.mend
        uses = self.uses if comparable and base.total < np.inf else []
        step = slopes_step(self.problem, self.settings.coarse)
        directions = simulate_directions(self.problem, base, uses, self.sets, step, self._screened())
        judge = Judge(self.model, self.problem, self.split, self.floor, self.settings.timestep)
        before = judge.judge(base)
        if not directions.uses:
            return _Found(coarse, base, judge, before, directions)
        screen = Screen(self.problem, base, directions, self.sets)
        gains = screen.held_out(screen.data)[:, :, 0]
        search = Search(self.problem, base, coarse.total, screen, gains, self.sets, self.settings, self.progress)
        fits = search.fit(search.best_by_screening(), FITS)
        fits = merged(fits, search.fit(search.rivals(fits), RIVALS, fits))
        after = {u: judge.judge(fine) for u, (_, fine) in fits.items()}
        error = judge.held_out_error(before)
        for look in (search.elsewhere, lambda fits: search.fit(search.hidden(fits), HIDDEN, fits)):
            least = min([error, *(judge.held_out_error(e) for e in after.values())])
            if least > WELL_PREDICTED and error - least < MOSTLY * (error - 1.0):
                further = look(fits)
                fits |= further
                after |= {u: judge.judge(fine) for u, (_, fine) in further.items()}
        return _Found(coarse, base, judge, before, directions, search, fits, after)

    def _rule(self, found: "_Found") -> Diagnosis:
        """Hold the candidates' gains against those of a search where nothing is missing, and conclude."""
        judge, before, after, directions = found.judge, found.before, found.after, found.directions
        drift, search = self._drift(found.coarse, found.base), found.search
        if search is None:
            return self._conclude(judge, before, drift, [], {}, Null.of_no_search(), directions)
        self.progress("simulating nothing missing", 0.97)
        leftover = min([found.base, *[fine for _, fine in found.fits.values()]], key=lambda f: f.total).residual
        rng = np.random.default_rng(self.settings.seed)
        null = simulate_null(self.problem, search.screen, found.base.scatter, leftover, self.sets, rng)
        alike = search.alike(list(found.fits))
        evidence = [
            screened(use, search.gains[:, u], search.screen.sizes, before.error)
            for u, use in enumerate(directions.uses)
            if u not in found.fits
        ]
        for u, (rough, fine) in found.fits.items():
            evidence.append(judge.evidence(directions.uses[u], after[u], before, self._drift(rough, fine)))
        judged = []
        for e in evidence:
            accepted, reason = accept(e, null.threshold, judge.unfitted)
            judged.append(dataclasses.replace(e, accepted=accepted, reason=reason, alike=alike.get(e.use, ())))
        every = (before, *after.values())
        elsewhere = {name: min(e.elsewhere[name] for e in every) for name in before.elsewhere}
        background = Background.of(null, min(e.error for e in every), elsewhere, leftover)
        detectable = detectable_sizes(self.problem, search.screen, background)
        named = {directions.uses[u]: e for u, e in after.items()}
        return self._conclude(judge, before, drift, ranked(judged), named, null, directions, detectable)

    def _screened(self) -> Callable[[str], None]:
        count = itertools.count(1)
        begin, end = SCREENING
        return lambda use: self.progress(f"screening {use}", begin + (end - begin) * next(count) / len(self.uses))

    def _drift(self, coarse: Fit, fine: Fit) -> np.ndarray:
        """(P,) how far the optimum may still move below the fine time step.

        From how far it moved down to it; and of a latency by half a step, by which a simulation alone is late.
        """
        step = self.settings.timestep
        rest = step / max(self.settings.coarse - step, step)
        moved = rest * np.abs(fine.unit - coarse.unit)
        widths = np.array([p.high - p.low for p in fine.model.parameters])
        late = np.where(are_latencies(fine.model), step / 2 / widths, 0.0)
        return np.maximum(moved, late)

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
        misfit, unfitted = judge.misfit(before), judge.unfitted_misfit()
        left = untried(self.model, self.uses)
        replayed = {use.partition(":")[0] for use in self.uses if use not in directions.random}
        count = len(replayed) if left else None
        late = overtaken(self.replay)
        apart = unsteady(self.replay, self.floor, late)
        random = suspected(self.model, self.replay, directions.random, before.error) if apart and not late else []
        names = [e.use for e in random]
        ruling = rule(
            ranking, misfit, kinds, unfitted, before.fit.converged, judge.unfitted, count, apart, names, bool(late)
        )
        if self.mend:
            ruling = Ruling(CANNOT_TELL, (), MEND_FIRST.format(" ".join(self.mend)))
        errors = {"unfitted": judge.unfitted, "base": before.error}
        best = ranking[0] if ranking and ranking[0].refined else None
        if best:
            errors[best.use] = best.error_after
        base = judge.evidence("", before, before, drift)
        named = ruling.uses[0] if ruling.verdict == EFFECT else ""
        leftover = explain(self.problem, (after[named] if named else before).held.residual, self.sets, named)
        beyond = f" {leftover.statement}" if ruling.verdict == OUTSIDE_LIBRARY else ""
        fits = {"": before.fit, **{use: judged.fit for use, judged in after.items()}}
        agreed = {
            e.use: agreement(self.problem, fits[e.use], self.sets, np.array(e.spread))
            for e in (base, *ranking)
            if e.refined
        }
        told = [use for use in ruling.uses if use in agreed] or [""]
        return Diagnosis(
            model=self.model.version,
            verdict=ruling.verdict,
            effects=tuple(dict.fromkeys(u.partition(":")[0] for u in ruling.uses)),
            uses=ruling.uses,
            statement=ruling.statement + beyond,
            ranking=(*ranking, *random),
            seconds=time.perf_counter() - self.began,
            rollouts=tuple(m.rollout_id for m in self.replay.measurements),
            sealed=tuple(m.rollout_id for m in sealed),
            threshold=null.threshold,
            errors=errors,
            floor_from_replicates=self.floor.from_replicates,
            untestable=directions.untestable,
            guards=(*self.lost, *self._guards(before, after), *_idle(self.problem, before.fit)),
            claims=tuple(
                claims(kinds, len(sealed), null, self.floor, self.settings)
                + left_out(left, self.uses)
                + not_simulated(directions.diverging, directions.random)
                + bounds(None if named else base, [e for e in (*ranking, *random) if e.use in ruling.uses])
                + [a.statement for use in told for a in disagreeing(agreed.get(use, ()))]
            ),
            base=base,
            moments=tuple(judge.moments(before, after)) if after else (),
            false_alarms=false_alarms(null),
            detectable=(
                *detectable,
                *(DetectableSize(use, reason=DIVERGES) for use in directions.diverging),
                *(DetectableSize(use, reason=AT_RANDOM) for use in directions.random),
            ),
            next_motions=self._next_motions(ruling, ranking, before, after, detectable),
            leftover=leftover,
            agreement=agreed,
            misfit=better_misfit(misfit, unfitted),
            kinds=kinds,
            untried=left,
            unsteady=apart,
            to_mend=tuple(self.mend),
        )

    def _guards(self, base: Judged, after: dict[str, Judged]) -> tuple[str, ...]:
        """Findings about the recordings, and about a lag of all signals.

        Against the base model held out; and, since its fit may have made up for a lag with slower servos, against the
        candidates that are a latency, as they would be without it.
        """
        observed = self.problem.observed[self.sets]
        between = np.stack([mean_of(self.replay.repeated(s)) for s in self.sets])  # readings of a slow recording
        measured = np.where(np.isfinite(observed), observed, between)
        first = [self.replay.replicates[s].members[0] for s in self.sets]
        names = [self.replay.measurements[r].rollout_id for r in first]
        late = common_lag(self.replay.layout, self.replay.time, measured, base.held.predicted, names)
        for use, judged in after.items():
            instant = without_latency(judged.fit.model, judged.fit.parameters)
            if instant is not None and use in LATENCIES and not late:
                sets, step = list(self.sets), self.settings.timestep
                predicted = self.replay.predict(judged.fit.model, instant[None], sets, step)[0]
                late = common_lag(self.replay.layout, self.replay.time, measured, predicted, names, use)
        line = unchecked_line(unchecked(self.measurements), [m.rollout_id for m in self.measurements])
        return (*guard(self.measurements), *late, *([line] if line else []))

    def _next_motions(
        self,
        ruling: Ruling,
        ranking: Sequence[Evidence],
        before: Judged,
        after: dict[str, Judged],
        sizes: Sequence[DetectableSize],
    ) -> tuple[NextMotion, ...]:
        """What to record next, where that is asked for or the rollouts cannot tell."""
        if self.mend or (ruling.verdict != CANNOT_TELL and not self.show):
            return ()
        self.progress("looking for the motion to record next", 0.98)
        motions, timestep = ready_motions(load_rig(self.model.rig), self.replay.measurements), self.settings.coarse
        found: tuple[NextMotion, ...] = ()
        if ruling.verdict == CANNOT_TELL:
            fits = {e.use: after[e.use].fit for e in ranking if e.use in after}
            found = excitation.between(self.problem, ruling.uses, before.fit, fits, motions, timestep)
        for use in self.show:
            size = min((s for s in sizes if s.use == use and s.value is not None), key=lambda s: s.share, default=None)
            truth = excitation.planted(before.fit, use, size)
            found += excitation.motions_that_show(self.problem, use, before.fit, truth, motions, timestep)
        return found


def _idle(problem: Problem, fit: Fit) -> list[str]:
    """Findings of parameters of the base model that change nothing over most of their ranges.

    Only those without a slope are simulated: some act beyond a threshold that the fit lies below.
    """
    if not fit.total < np.inf:
        return []
    change = (IDLE_SPAN[1] - IDLE_SPAN[0]) * fit.jacobian / problem.floor[:, None]
    flat = np.flatnonzero(np.sqrt((change**2).mean(axis=1)).max(axis=(0, 1)) < IDLE).tolist()
    every = range(len(problem.replay.replicates))
    idle = without_change(fit.model, problem.replay, fit.parameters, problem.floor, flat, every) if flat else []
    return [idle_parameter(fit.model.names[p]) for p in idle]


def _only_forward(progress: Progress) -> Progress:
    """The same, but the share never falls: a search that begins again has done what it did."""
    most = 0.0

    def told(stage: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        progress(stage, most)

    return told
