"""How a diagnosis came out, in a word, and who was taken for whom."""

from collections import Counter
from typing import Any

from hidden_effects.truth import Result, outside, right_uses
from tcbi_bringup.emulated_robot.hidden_names import NONE, parts
from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, NOTHING_MISSING, OUTSIDE_LIBRARY

RIGHT, UNSURE, WRONG, MISSED, FALSE_ALARM = "right", "unsure", "wrong", "missed", "false alarm"
FLAGGED, BOTH, BOTH_AND_MORE, ONE = "flagged", "both", "both and another", "one of two"


def outcome(result: Result) -> str:
    """In a word.

    - Nothing hidden: right, or a false alarm: an effect is named, or something is said to be missing. Not being able to
      tell is one too, unless it names no effect.
    - One effect of the library: right (named, in its place), unsure (cannot tell, the truth among those named), wrong
      (another is named, or the truth is not among those named), missed (nothing missing, or none of the library).
    - One outside the library: flagged, unsure (cannot tell), wrong (an effect is named), missed (nothing missing).
    - Several: both, both and another, one of two, wrong (only others), missed (none named).
    """
    hidden, verdict = result["hidden"], result["verdict"]
    if hidden == NONE:
        silent = verdict == NOTHING_MISSING or (verdict == CANNOT_TELL and not result["uses"])
        return RIGHT if silent else FALSE_ALARM
    if outside(hidden):
        return {OUTSIDE_LIBRARY: FLAGGED, CANNOT_TELL: UNSURE, EFFECT: WRONG}.get(verdict, MISSED)
    if len(parts(hidden)) > 1:
        return _of_several(result)
    right = right_uses(result)
    if verdict == EFFECT:
        return RIGHT if right & set(result["uses"]) else WRONG
    if verdict == CANNOT_TELL:
        return UNSURE if right & set(result["uses"]) else WRONG
    return MISSED


def ranked_first(result: Result) -> bool:
    """Whether the ranking begins with what is hidden, whatever the verdict says of it."""
    return result["first"] in right_uses(result)


def twin_ranked_first(result: Result) -> bool:
    """Whether the ranking begins with an effect that these data show to be the same as what is hidden."""
    best = result["ranking"][0] if result["ranking"] else {}
    return not ranked_first(result) and bool(right_uses(result) & set(best.get("confused_with", ())))


def confusion(results: list[Result]) -> dict[str, dict[str, int]]:
    """What was hidden (with its strength) -> what was said first -> robots; places left out."""
    table: dict[str, Counter[str]] = {}
    for r in results:
        row = r["hidden"] if r["hidden"] == NONE else f"{r['hidden']} ({r['strength']})"
        table.setdefault(row, Counter())[_said(r)] += 1
    return {row: dict(counts.most_common()) for row, counts in table.items()}


def as_text(table: dict[str, dict[str, int]]) -> str:
    """The confusion matrix as lines; what was said is listed instead of a column for each, as most are empty."""
    width = max((len(row) for row in table), default=0)
    return "\n".join(
        f"{row:<{width}}  " + ", ".join(f"{said} {n}" for said, n in c.items()) for row, c in table.items()
    )


def _of_several(result: Result) -> str:
    named, right = set(result["found"]), right_uses(result)
    if not named:
        return MISSED
    if right <= named:
        return BOTH if right == named else BOTH_AND_MORE
    return ONE if right & named else WRONG


def _said(result: dict[str, Any]) -> str:
    if not result["found"]:
        return str(result["verdict"]).replace("_", " ")
    return " + ".join(use.partition(":")[0] for use in result["found"])
