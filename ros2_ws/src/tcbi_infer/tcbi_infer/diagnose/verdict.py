"""From evidence to a verdict: what is required of an effect before it is named, and how the verdict is worded."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from tcbi_infer.compare.replicates import MIN_KINDS, SURE_KINDS
from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.evidence import (
    CANNOT_TELL,
    EFFECT,
    EXPLAINED,
    HEADLINES,
    NOTHING_MISSING,
    OUTSIDE_LIBRARY,
    UNEXPLAINED,
    WELL_PREDICTED,
    Evidence,
    Misfit,
    in_doubt,
)

USEFUL = 0.05  # of the error over the floor: an effect must lower it at least by this share
ELSEWHERE = 0.2  # the same of one other kind of signal, where an effect of a sensor shows in no joint and no attitude
NOTICEABLE = 1.5  # times the noise floor: less leaves nothing to be explained
MOSTLY = 1 / 2  # of the excess error: nothing is called complete that one more effect would explain so far
HINTED = 1 / 2  # of what a single candidate's statistic must be: with less, a share of the error is found by chance
CONTRADICTED = "it lowers the error of the motions held out in turn, but not that of the sealed ones"
NOT_TOLD = "These rollouts cannot tell what is missing"
IN_TURN = "on the motions held out in turn"


@dataclasses.dataclass(frozen=True)
class Ruling:
    """A verdict and its wording."""

    verdict: str
    uses: tuple[str, ...]
    statement: str


def accept(evidence: Evidence, threshold: float, unfitted: float) -> tuple[bool, str]:
    """Whether a candidate passes every requirement, and if not, which it failed.

    Args:
      evidence: for it.
      threshold: of its statistic.
      unfitted: error over the floor of the model as it was, on the motions of `error_after`.
    """
    if not evidence.refined:
        return False, "its first estimate was too low for a full fit"
    if not np.isfinite(threshold):
        return False, "of one kind of motion none can be held out"
    if not evidence.statistic > threshold:
        told = f"{evidence.statistic:.1f} standard errors above zero"
        return False, f"the roots of its held-out gains lie {told}, those of the search alone {threshold:.1f}"
    sized = [p for p in evidence.parameters if p.null is not None]
    if sized and not any(p.excludes_null for p in sized):
        return False, "its size may be zero"
    if not evidence.converged:
        return False, "its fit did not converge"
    if not np.isfinite(evidence.error_after):
        return False, f"its fit diverges {_where(evidence)}"
    if _lowered(evidence.error_after, unfitted):
        return False, f"the model as it was, not fitted at all, errs less ({unfitted:.1f} times the noise floor)"
    if not _lowered(evidence.error_before, evidence.error_after) and not shows_in(evidence):
        contradicted = evidence.held_out and _lowered(*evidence.held_out)
        return False, CONTRADICTED if contradicted else "it hardly lowers the error"
    return True, ""


def shows_in(evidence: Evidence) -> str:
    """The kind of signal beside joints and attitude whose error an effect lowers, where it leaves theirs; else ""."""
    if _lowered(evidence.error_after, evidence.error_before):
        return ""
    left = {name: after / before for name, (before, after) in evidence.elsewhere.items() if before > NOTICEABLE}
    least = min(left, key=lambda name: left[name], default="")
    return least if least and left[least] < 1 - ELSEWHERE else ""


def _lowered(before: float, after: float) -> bool:
    return after < (1 - USEFUL) * before


def rivals(best: Evidence, others: Sequence[Evidence]) -> list[Evidence]:
    """Accepted candidates that a paired test over kinds of motion cannot tell from the best one."""
    result = []
    for other in others:
        difference = np.array(best.gains) - np.array(other.gains)
        statistic = paired.statistic(difference, np.array(best.sizes or [1] * len(difference)))
        if not statistic >= paired.limit(len(difference)):
            result.append(other)
    return result


def indistinct(best: Evidence, others: Sequence[Evidence]) -> list[Evidence]:
    """Accepted candidates that must be named with the best one.

    Those that the gains cannot tell from it, except a richer law of the same look that leaves as much error; and those
    no richer that change the signals alike, or leave as little error, whatever the gains say: between these a
    discrepancy of the simulation decides, not the robot. What a gain must be worth to name an effect, it must be to
    tell it from another.
    """
    unclear = {r.use for r in rivals(best, others)}
    return [o for o in others if not _no_better(best, o) and (o.use in unclear or _as_good(best, o))]


def _as_good(best: Evidence, other: Evidence) -> bool:
    count, own = len(other.parameters), len(best.parameters)
    alike = other.use in best.alike and count == own
    return alike or (count <= own and not _lowered(other.error_after, best.error_after))


def better(best: Evidence, ranking: Sequence[Evidence]) -> list[Evidence]:
    """Candidates that predict unseen motions better than the best of the accepted, though less surely."""
    return [
        e
        for e in ranking
        if e.refined
        and not e.accepted
        and e.converged
        and e.elpd_gain > best.elpd_gain
        and e.error_after < best.error_after
    ]


def _no_better(best: Evidence, other: Evidence) -> bool:
    """Whether `other` is a richer law of the same look that leaves as much error."""
    return _richer_twin(best, other) and not _lowered(best.error_after, other.error_after)


def _richer_twin(best: Evidence, other: Evidence) -> bool:
    """Whether `other` has more parameters, looks the same and predicts no better: no rival of the plainer law."""
    return other.use in best.alike and len(other.parameters) > len(best.parameters)


def _plainest(accepted: Sequence[Evidence]) -> Evidence | None:
    """The best one, or a plainer law of the same look that the gains cannot tell from it and that errs as little."""
    if not accepted:
        return None
    best = accepted[0]
    plainer = [o for o in rivals(best, accepted[1:]) if _richer_twin(o, best)]
    return next((o for o in plainer if not _lowered(o.error_after, best.error_after)), best)


def ranked(judged: Sequence[Evidence]) -> list[Evidence]:
    """Best first, but a plainer law that does as well; each accepted one with those that gains cannot tell from it."""
    accepted = [e for e in judged if e.accepted]
    marked = []
    for e in judged:
        near = {r.use for r in rivals(e, [o for o in accepted if o is not e])} if e.accepted else set()
        marked.append(dataclasses.replace(e, confused_with=tuple(sorted(near | set(e.alike)))))
    order = sorted(marked, key=lambda e: (not e.accepted, not e.refined, -e.elpd_gain))
    best = _plainest([e for e in order if e.accepted])
    return [e for e in order if e is best] + [e for e in order if e is not best]


def rule(
    ranking: Sequence[Evidence],
    base: Misfit,
    kinds: int,
    unfitted: Misfit,
    base_converged: bool = True,
    unseen: float = np.inf,
    tried: int | None = None,
    unsteady: str = "",
    suspected: Sequence[str] = (),
    late: bool = False,
) -> Ruling:
    """The verdict.

    Args:
      ranking: candidates, best first, acceptance decided.
      base: held-out error of the refitted base model.
      kinds: of motion.
      unfitted: of the model as it was, on the same motions as `base`.
      base_converged: whether the base model's own fit did; a bad one looks like a missing effect.
      unseen: error over the floor of the model as it was, on the motions of `error_after`; infinite if not known.
      tried: effects of the library that were tried; None for all of them.
      unsteady: that the robot does not repeat itself, in a sentence; then neither one effect nor that none is missing
        is told.
      suspected: uses of which an unsteady robot's repeats tell a size, and no replay anything.
      late: whether an unsteady robot follows commands after the next is due, which no effect does.
    """
    ruling = _ruled(ranking, base, kinds, unfitted, base_converged, unseen, tried)
    if not unsteady:
        return ruling
    if late and kinds > 1 and tried != 0 and not in_doubt(base_converged, base.total, ranking):
        passes = f"{ranking[0].use} passes every test beside. " if ranking and ranking[0].accepted else ""
        return Ruling(OUTSIDE_LIBRARY, (), f"No effect of the library delays single commands. {passes}{unsteady}")
    told = f"{unsteady} {' or '.join(suspected)} would do that." if suspected else unsteady
    if ruling.verdict == NOTHING_MISSING or (ruling.verdict == OUTSIDE_LIBRARY and suspected):
        what = "Something may be missing that no replay can judge" if suspected else NOT_TOLD
        return Ruling(CANNOT_TELL, tuple(suspected), f"{what}. {told}")
    verdict = CANNOT_TELL if ruling.verdict == EFFECT else ruling.verdict  # lost commands look like damping in the mean
    return Ruling(verdict, (*ruling.uses, *suspected), f"{ruling.statement} {told}")


def _ruled(
    ranking: Sequence[Evidence],
    base: Misfit,
    kinds: int,
    unfitted: Misfit,
    base_converged: bool,
    unseen: float,
    tried: int | None,
) -> Ruling:
    accepted = [e for e in ranking if e.accepted]
    if kinds < 2:
        return Ruling(
            CANNOT_TELL,
            (),
            "These rollouts show one kind of motion, so that no fit can be tried on another"
            f"{'' if ranking else ', no candidate was tried'} and nothing is told: "
            f"fitted to it, the model still errs by {base.total:.1f} times the noise floor. Record {SURE_KINDS} kinds "
            "of motion or more, each twice.",
        )
    if in_doubt(base_converged, base.total, ranking):
        doubt = f", and {accepted[0].use} may only make up for that" if accepted else ""
        return Ruling(
            CANNOT_TELL,
            tuple(e.use for e in accepted[:1]),
            f"The fit of the base model did not converge{doubt}: it errs by {base.total:.1f} times the noise floor "
            f"{IN_TURN}. Begin nearer to the robot (./tcbi infer makes such a version), or record calmer motions.",
        )
    if not accepted:
        return _none_accepted(ranking, base, kinds, unfitted, unseen, tried)
    best = accepted[0]
    left, most = best.error_after, max(accepted, key=_explained)
    if all(_leaves_much(e) for e in accepted) and _explained(most) < EXPLAINED:
        return Ruling(
            OUTSIDE_LIBRARY,
            (),
            f"{HEADLINES[OUTSIDE_LIBRARY] if tried is None else UNEXPLAINED}: the base model errs by "
            f"{best.error_before:.1f} times the noise floor, and the best candidate ({most.use}) explains only "
            f"{100 * max(_explained(most), 0):.0f} % of the excess.",
        )
    equal = indistinct(best, accepted[1:]) + better(best, ranking)
    caveat = "" if kinds >= MIN_KINDS else f" With {kinds} kinds of motion no false-alarm rate is claimed."
    little = best.explains_little and not shows_in(best)
    if equal:
        names = " or ".join([best.use, *(e.use for e in equal)])
        part = " None of them explains a third of it." if little and all(e.explains_little for e in equal) else ""
        return Ruling(
            CANNOT_TELL,
            (best.use, *(e.use for e in equal)),
            f"Something is missing, but these rollouts cannot tell which: {names}.{part}{caveat}",
        )
    if little:
        return Ruling(
            CANNOT_TELL,
            (best.use,),
            f"Something is missing, of which {best.use} explains only {100 * max(_explained(best), 0):.0f} %: with it "
            f"the error {_where(best)} falls from {best.error_before:.1f} to {left:.1f} times the noise floor. It "
            f"may be there beside something else, or look a little like what is.{caveat}",
        )
    still = " Much is left to explain: add it, and diagnose the new version again." if left > WELL_PREDICTED else ""
    before, after, of, stays = best.error_before, left, "", ""
    if not _lowered(before, left) and (signal := shows_in(best)):
        (before, after), of = best.elsewhere[signal], f" of {signal.replace('_', ' ')}"
        stays = f" That of joints and attitude stays at {left:.1f}."
    return Ruling(
        EFFECT,
        (best.use,),
        f"The model lacks {best.use}: with it the error{of} {_where(best)} falls from "
        f"{before:.1f} to {after:.1f} times the noise floor.{stays}{still}{caveat}",
    )


def _leaves_much(e: Evidence) -> bool:
    """On the sealed motions and on those held out in turn: the sealed are few, and one of them may slip otherwise."""
    return min(e.error_after, (e.held_out or (np.inf, np.inf))[1]) > WELL_PREDICTED


def _where(e: Evidence) -> str:
    """Of which motions its errors are: sealed ones or, where none are, those held out in turn."""
    return IN_TURN if e.held_out == (e.error_before, e.error_after) else "on motions that no fit has seen"


def _explained(e: Evidence, unfitted: float = np.inf) -> float:
    """The share of the error beyond the floor that a candidate explains; 0 where it was not fitted."""
    before = min(e.error_before, unfitted)
    if not np.isfinite(before):
        return float(np.isfinite(e.error_after))
    return (before - e.error_after) / max(before - 1.0, 1e-6) if e.refined else 0.0


def better_misfit(base: Misfit, unfitted: Misfit) -> Misfit:
    """Of the base model, refitted or as it was, whichever predicts better."""
    return unfitted if _lowered(base.total, unfitted.total) else base


def _none_accepted(
    ranking: Sequence[Evidence], base: Misfit, kinds: int, unfitted: Misfit, unseen: float, tried: int | None
) -> Ruling:
    best, misfit = ranking[0] if ranking else None, better_misfit(base, unfitted)
    error = f"{IN_TURN} the refitted model errs by {base.total:.1f} times the noise floor"
    if misfit is unfitted:
        error = (
            f"{IN_TURN} the model as it was errs by {unfitted.total:.1f} times the noise floor, refitted by "
            f"{base.total:.1f}"
        )
    hint = f" The best candidate was {best.use}: {best.reason}." if best else ""
    if best and best.reason == CONTRADICTED:
        return Ruling(
            CANNOT_TELL,
            (best.use,),
            f"Something may be missing: {best.use} passes every test but one: {CONTRADICTED}. Record more motions.",
        )
    badly = misfit.total > WELL_PREDICTED and _in_most(misfit.by_kind or {"": misfit.total})
    tilted = _in_most(misfit.attitude)
    lost = badly or tilted or not np.isfinite(misfit.total)
    if best and (_all_but_sure(best, kinds, unseen) or _hinted(best, misfit, kinds, unseen, lost)):
        much = misfit.total > NOTICEABLE
        explains = f" explains {100 * _explained(best, unseen):.0f} % of the excess, but" if much else ""
        return Ruling(
            CANNOT_TELL,
            (best.use,),
            f"Something may be missing: {error}. {best.use}{explains} is not certain: {best.reason}.",
        )
    # where nothing was tried, nothing is known of the library
    beyond = CANNOT_TELL if tried == 0 else OUTSIDE_LIBRARY
    if badly:
        return Ruling(beyond, (), f"{error[0].upper()}{error[1:]}, and {_unexplained(tried)}.{hint}")
    if tilted:
        tilts = f"roll and pitch by {np.median(list(misfit.attitude.values())):.1f} in the median kind of motion"
        return Ruling(beyond, (), f"{error[0].upper()}{error[1:]}, {tilts}, and {_unexplained(tried)}.{hint}")
    few = "" if kinds >= MIN_KINDS else f" With {kinds} kinds of motion small effects cannot be seen."
    if misfit.total > WELL_PREDICTED:
        worst = max(misfit.by_kind, key=lambda name: misfit.by_kind[name])
        return Ruling(
            NOTHING_MISSING,
            (),
            f"No effect is named: {error}; in {misfit.badly_predicted} of {kinds} kinds of motion by more than "
            f"{WELL_PREDICTED:g}, most in {worst}, by {misfit.by_kind[worst]:.1f}. That is too few to say that the "
            f"library lacks something: see what differs there (a slip, a knock), and record it again.{hint}{few}",
        )
    return Ruling(
        NOTHING_MISSING,
        (),
        f"These rollouts show nothing missing: {error}.{hint}{few}",
    )


def _all_but_sure(best: Evidence, kinds: int, unseen: float) -> bool:
    """Whether a candidate passes every requirement but that it stands out from what a search finds by chance."""
    return accept(best, HINTED * paired.limit(kinds), unseen)[0]


def _hinted(best: Evidence, misfit: Misfit, kinds: int, unseen: float, badly: bool) -> bool:
    """Whether a candidate that is not accepted explains so much that nothing can be called complete without it.

    By the share of the error alone where the model errs so badly that the alternative is a library that has nothing, or
    where no rate is claimed.
    """
    if misfit.total <= NOTICEABLE:
        return False
    much = EXPLAINED if misfit.total > WELL_PREDICTED else MOSTLY
    agreed = badly or kinds < MIN_KINDS or best.statistic >= HINTED * paired.limit(kinds)
    return agreed and _explained(best, unseen) >= much


def _unexplained(tried: int | None) -> str:
    if tried is None:
        return "no effect of the library explains it"
    if tried == 0:
        return "no effect was tried"
    return f"none of the {tried} effects tried explains it" if tried > 1 else "the one effect tried does not explain it"


def _in_most(errors: Mapping[str, float]) -> bool:
    """Whether more than half of the kinds of motion err so much that it is no slip in some of them."""
    return sum(error > WELL_PREDICTED for error in errors.values()) > len(errors) / 2
