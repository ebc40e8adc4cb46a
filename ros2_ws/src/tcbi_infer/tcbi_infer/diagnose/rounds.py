"""One effect after another: add what a diagnosis names, diagnose the new version, until nothing more is named.

for found in rounds(model, measurements, keep=store.save):
    found.diagnosis.statement, found.added

Where a diagnosis names none, for two effects explain much and neither alone explains it all, each is tried beside the
other: both are added if each is named with the other in the model, one if it is needed beside the other and not the
other beside it.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from tcbi_contract.wording import counted
from tcbi_infer.diagnose.adopt import adopt, objection
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, OUTSIDE_LIBRARY, WELL_PREDICTED, Diagnosis, Evidence
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model

MOST = 3  # effects, unless more are asked for
NO_EFFECT = "no effect is named"


@dataclass(frozen=True)
class Round:
    """One diagnosis and what follows from it.

    Attributes:
      model: that was diagnosed.
      diagnosis: what was found.
      added: the next version, with one effect more; None at the end.
      use: the effect that was added, "" for none.
      resolved: why it was added though this diagnosis names none; empty where it does.
      ending: why the search ends here; empty where it goes on.
    """

    model: Model
    diagnosis: Diagnosis
    added: Model | None
    use: str = ""
    resolved: str = ""
    ending: str = ""


def rounds(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    most: int = MOST,
    uses: Sequence[str] | None = None,
    anyway: bool = False,
    keep: Callable[[Model], Model] | None = None,
    **options: Any,
) -> Iterator[Round]:
    """Diagnoses, each of the version that the one before made.

    All use the same split, so that what one held out or sealed stays so in the next.

    Args:
      model: to begin with.
      measurements: rollouts, as in `diagnose`.
      most: effects to add, at most.
      uses: candidates; the whole library by default.
      anyway: whether to add an effect though the kinds of motion disagree on its size.
      keep: what becomes of a new version before it is diagnosed: saved, for one.
      options: of `diagnose`.

    Raises:
      CompareError: nothing to compare, or another rig's rollouts.
    """
    begun, search = model, _Search(measurements, uses, anyway, options)
    while True:
        diagnosis = search.diagnose(model)
        plan, why_not = search.plan(model, diagnosis, most - len(model.effects) + len(begun.effects))
        if why_not:
            yield Round(model, diagnosis, None, ending=why_not)
            return
        for step in plan:
            made = dataclasses.replace(step.diagnosis, model=model.version)  # of a version that was not kept
            child = adopt(model, step.use, made.to_json())
            added = keep(child) if keep else child
            ending = _ending(added, len(added.effects) - len(begun.effects), most, uses)
            yield Round(model, made, added, step.use, step.resolved, ending)
            if ending:
                return
            model = added


def _ending(added: Model, count: int, most: int, uses: Sequence[str] | None) -> str:
    if count >= most:
        return f"{counted(most, 'effect')} at most"
    return "no candidate is left to try" if uses is not None and set(uses) <= set(added.effects) else ""


class _Step(NamedTuple):
    """An effect to add, from the diagnosis that fitted it."""

    use: str
    diagnosis: Diagnosis
    resolved: str = ""


class _Search:
    """Diagnoses of one set of rollouts, and what they say is to be added."""

    def __init__(
        self, measurements: Sequence[Measurement], uses: Sequence[str] | None, anyway: bool, options: dict[str, Any]
    ) -> None:
        self.measurements, self.uses, self.anyway, self.options = measurements, uses, anyway, options

    def diagnose(self, model: Model, among: Sequence[str] | None = None) -> Diagnosis:
        """With all candidates that the model has not yet, or some."""
        uses = self.uses if among is None else among
        left = None if uses is None else [use for use in uses if use not in model.effects]
        return diagnose(model, self.measurements, uses=left, **self.options)

    def plan(self, model: Model, found: Diagnosis, room: int) -> tuple[list[_Step], str]:
        """The effects to add one after another, or why there is none.

        Args:
          model: that was diagnosed.
          found: its diagnosis.
          room: how many effects may be added.
        """
        if found.verdict == EFFECT:
            steps, why_not = [_Step(found.uses[0], found)], ""
        else:
            steps, why_not = self._beside_each_other(model, found) if room > 1 else ([], NO_EFFECT)
        if not steps:
            return [], why_not
        objections = [] if self.anyway else [objection(step.diagnosis.to_json(), step.use) for step in steps]
        told = next(filter(None, objections), "")
        return ([], told) if told else (steps, "")

    def _beside_each_other(self, model: Model, found: Diagnosis) -> tuple[list[_Step], str]:
        """Two effects to add where none is named, or what was tried in vain."""
        accepted = [e for e in found.ranking if e.accepted]
        if found.unsteady:  # then no diagnosis names an effect
            return [], NO_EFFECT
        if found.verdict == CANNOT_TELL and len(accepted) > 1 and accepted[1].use not in accepted[0].alike:
            a, b = accepted[0].use, accepted[1].use
            why_not = f"no effect is named: {a} and {b} were tried beside each other, and neither is needed there"
            return self._two(model, found, a, b), why_not
        a = _part(found, accepted) or _leader_in_doubt(found)
        if not a:
            return [], NO_EFFECT
        why_not = (
            f"no effect is named: {a} explains a part, and no second effect beside it was found that explains the "
            f"rest (./tcbi add {a} takes it alone)"
        )
        return self._second(model, found, a), why_not

    def _two(self, model: Model, found: Diagnosis, a: str, b: str) -> list[_Step]:
        """Of two that were not told apart: both, or the one that the other does not replace."""
        beside_a = self._needed(adopt(model, a, found.to_json()), b)
        beside_b = self._needed(adopt(model, b, found.to_json()), a)
        if beside_a and beside_b:
            why = f"Both are missing: {b} is named beside {a}, and {a} beside {b}."
            return [_Step(a, found, why), _Step(b, beside_a)]
        if beside_a or beside_b:
            one, other = (b, a) if beside_a else (a, b)
            return [_Step(one, found, f"{one} is named beside {other}, and {other} is not beside {one}.")]
        return []

    def _second(self, model: Model, found: Diagnosis, a: str) -> list[_Step]:
        """Where one explains only a part: that and another one, if together they leave nothing outside the library."""
        with_a = adopt(model, a, found.to_json())
        beside_a = self.diagnose(with_a)
        if beside_a.verdict != EFFECT:
            return []
        b = beside_a.uses[0]
        left = self.diagnose(adopt(with_a, b, beside_a.to_json()))
        if left.verdict == OUTSIDE_LIBRARY:
            return []
        alone = found if _fitted(found, b) else self.diagnose(model, [b])
        if not _fitted(alone, b) or not self._needed(adopt(model, b, alone.to_json()), a):
            return []
        why = f"Neither explains it alone, both together do: {b} is named beside {a}, and {a} beside {b}."
        return [_Step(a, found, why), _Step(b, beside_a)]

    def _needed(self, model: Model, use: str) -> Diagnosis | None:
        """A diagnosis that names this one effect; None where it does not."""
        found = self.diagnose(model, [use])
        return found if found.verdict == EFFECT else None


def _part(found: Diagnosis, accepted: Sequence[Evidence]) -> str:
    """The accepted candidate that explains only a part of what the model lacks, or ""."""
    if not accepted or not found.base.converged:
        return ""
    alone = found.verdict == CANNOT_TELL and len(found.uses) == 1 and accepted[0].explains_little
    return accepted[0].use if alone or found.verdict == OUTSIDE_LIBRARY else ""


def _leader_in_doubt(found: Diagnosis) -> str:
    """The candidate that may be missing but passes no test of its own, where much is left beside it; else ""."""
    leader = found.ranking[0] if found.ranking else None
    doubted = leader and not leader.accepted and found.verdict == CANNOT_TELL and leader.use in found.uses
    return leader.use if leader and doubted and leader.refined and leader.error_after > WELL_PREDICTED else ""


def _fitted(found: Diagnosis, use: str) -> bool:
    return any(e.use == use and e.refined for e in found.ranking)


def steps(found: Sequence[Round]) -> list[tuple[str, float]]:
    """The error over the noise floor on held-out motions: the first model, then with each effect added."""
    told = [(f"{r.model.version}, parameters fitted", r.diagnosis.errors["base"]) for r in found[:1]]
    for r in found:
        if r.added is not None:
            error = next(e.error_after for e in r.diagnosis.ranking if e.use == r.use)
            told.append((f"{r.added.version}, with {r.use}", error))
    return told
