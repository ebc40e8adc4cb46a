"""What a diagnosis rests on, in sentences."""

from collections import Counter
from collections.abc import Sequence

from tcbi_contract.wording import counted, with_unit
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.diagnose.at_random import AT_RANDOM
from tcbi_infer.diagnose.evidence import Evidence, ParameterEstimate
from tcbi_infer.diagnose.false_alarms import false_alarms
from tcbi_infer.diagnose.null import Null
from tcbi_infer.diagnose.settings import Settings


def claims(kinds: int, sealed: int, null: Null, floor: NoiseFloor, settings: Settings) -> list[str]:
    """What was held out, the rate of false alarms, and where the noise floor comes from.

    Args:
      kinds: of motion.
      sealed: rollouts.
      null: what a search gains where nothing is missing.
      floor: of the recordings.
      settings: of the diagnosis.
    """
    if kinds < 2:
        told = ["Nothing was held out: the errors shown are those on the motion of the fit itself."]
    else:
        told = [f"{kinds} kinds of motion were held out in turn."]
        if sealed:
            told.append(
                f"{counted(sealed, 'rollout')} stayed sealed: no fit and no search saw them. The errors shown are "
                "theirs, and an effect that does not lower them is refused."
            )
    if not sealed and kinds >= 2:
        why = "Too few kinds of motion to seal any" if settings.sealed_share else "A quick look seals none"
        told.append(f"{why}: the errors shown are cross-validated.")
    told.append(false_alarms(null).statement)
    if not floor.from_replicates:
        told.append(floor.statement)
    return told


def left_out(left: Sequence[str], uses: Sequence[str]) -> list[str]:
    """A sentence on the effects of the library that were left out, at some places or at all.

    Args:
      left: uses that were left out.
      uses: those tried.
    """
    places = Counter(use.partition(":")[0] for use in left)
    kept = {use.partition(":")[0] for use in uses}
    told = [f"{name} at {counted(count, 'place')}" if name in kept else name for name, count in places.items()]
    return [f"Not tried: {', '.join(told)}."] if told else []


def not_simulated(diverging: Sequence[str], random: Sequence[str]) -> list[str]:
    """Sentences on the candidates whose simulations diverge, and on those that no simulation can repeat."""
    told = [f"Not tested, since simulations with it diverge: {', '.join(diverging)}."] if diverging else []
    return told + [f"Not tried by replay, since {AT_RANDOM}: {', '.join(random)}."] * bool(random)


def bounds(base: Evidence | None, named: Sequence[Evidence]) -> list[str]:
    """A sentence on each parameter that the fits left at an end of its range, or whose interval ends there.

    Args:
      base: the base model; None where an effect is named, with which it is no longer the model.
      named: the candidates of the verdict.
    """
    told = []
    for e in (*([] if base is None else [base]), *named):
        for p in (p for p in e.parameters if p.at_bound):
            why = "a wrong range or another missing effect may be behind it" if e is base else _beyond(p)
            end = with_unit(f"{p.value:.3g}", p.unit)
            where = "Without an effect, " if e is base and named else ""
            told.append(f"{where}{p.name} stopped at an end of its range, {end}: its interval is one-sided, and {why}.")
    cut_off = (p.name for e in named for p in e.parameters if p.cut_off)
    return told + [f"The interval of {name} ends where its range does, and might be wider." for name in cut_off]


def _beyond(p: ParameterEstimate) -> str:
    """Which way a value that stopped at an end of its range may go on."""
    if p.null is not None:
        return "the effect may be larger"
    return f"its value may be {'larger' if p.high90 - p.value < p.value - p.low90 else 'smaller'}"
