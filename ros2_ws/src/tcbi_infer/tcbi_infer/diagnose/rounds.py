"""One effect after another: add what a diagnosis names, diagnose the new version, until nothing more is named.

for found in rounds(model, measurements, keep=store.save):
    found.diagnosis.statement, found.added
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from tcbi_contract.wording import counted
from tcbi_infer.diagnose.adopt import adopt, objection
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import EFFECT, Diagnosis
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model

MOST = 3  # effects, unless more are asked for


@dataclass(frozen=True)
class Round:
    """One diagnosis and what follows from it.

    Attributes:
      model: that was diagnosed.
      diagnosis: what was found.
      added: the next version, with the effect named; None at the end.
      ending: why the search ends here; empty where it goes on.
    """

    model: Model
    diagnosis: Diagnosis
    added: Model | None
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
    for count in range(1, most + 1):
        left = None if uses is None else [use for use in uses if use not in model.effects]
        diagnosis = diagnose(model, measurements, uses=left, **options)
        ending = "" if diagnosis.verdict == EFFECT else "no effect is named"
        if not ending and not anyway:
            ending = objection(diagnosis.to_json(), diagnosis.uses[0])
        if ending:
            yield Round(model, diagnosis, None, ending)
            return
        child = adopt(model, diagnosis.uses[0], diagnosis.to_json())
        added = keep(child) if keep else child
        ending = f"{counted(most, 'effect')} at most" if count == most else ""
        if not ending and uses is not None and set(uses) <= set(added.effects):
            ending = "no candidate is left to try"
        yield Round(model, diagnosis, added, ending)
        if ending:
            return
        model = added


def steps(found: Sequence[Round]) -> list[tuple[str, float]]:
    """The error over the noise floor on held-out motions: the first model, then with each effect added."""
    told = [(f"{r.model.version}, parameters fitted", r.diagnosis.errors["base"]) for r in found[:1]]
    for r in found:
        if r.added is not None:
            use = r.diagnosis.uses[0]
            told.append((f"{r.added.version}, with {use}", r.diagnosis.errors[use]))
    return told
