"""The figures of the benchmark beside their targets."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy.special import betaincinv

from hidden_effects import outcomes
from hidden_effects.truth import Result, base_hits, finite, outside, size_hits
from tcbi_bringup.commands.bench import figure
from tcbi_bringup.emulated_robot.hidden_names import NONE, STRENGTHS, parts

Figure = dict[str, Any]
FIRST = {"strong": 0.95, "weak": 0.85}  # true effect ranked first
FIRST_OR_UNSURE, FALSE_ALARMS, PAIRS, OUTSIDE = 0.97, 0.05, 0.70, 0.90
ERROR_AFTER, DIAGNOSIS_S, MEMORY_MIB, COVERAGE = 1.2, 60.0, 2048.0, (0.85, 0.95)
SURE = 0.95  # of a one-sided limit
SIZES_HOLD = "90 % intervals of effects' sizes that hold the truth"
VERSIONS = {
    "unfitted": "model as it was, not fitted",
    "fitted": "without an effect, parameters fitted",
    "added": "with what was named, parameters fitted",
}


def figures(found: list[Result]) -> list[Figure]:
    """Shares of every outcome, coverage of intervals, errors and cost, the summaries that have targets first."""
    rows = [*_nothing(found), *_single(found), *_several(found), *_outside(found), *_coverage(found)]
    return [*rows, *_errors(found), *_cost(found), *_each(found)]


def _nothing(found: list[Result]) -> list[Figure]:
    mine = [outcomes.outcome(r) for r in found if r["hidden"] == NONE]
    alarms = mine.count(outcomes.FALSE_ALARM)
    if not mine:
        return []
    most = 1.0 if alarms == len(mine) else float(betaincinv(alarms + 1, len(mine) - alarms, SURE))
    return [
        figure("false alarms with nothing hidden", alarms / len(mine), f"of {len(mine)}", most=FALSE_ALARMS),
        figure("the same, at most, with 95 % confidence", most, "1"),
    ]


def _single(found: list[Result]) -> list[Figure]:
    rows = []
    for strength in STRENGTHS:
        mine = [r for r in found if _is_single(r) and r["strength"] == strength]
        if not mine:
            continue
        unit, words = f"of {len(mine)}", [outcomes.outcome(r) for r in mine]
        named, unsure = words.count(outcomes.RIGHT), words.count(outcomes.UNSURE)
        first, twins = sum(map(outcomes.ranked_first, mine)), sum(map(outcomes.twin_ranked_first, mine))
        rows += [
            figure(f"{strength} effects ranked first", first / len(mine), unit, least=FIRST[strength]),
            figure(f"{strength} effects whose likeness on these data is ranked first", twins / len(mine), unit),
            figure(f"{strength} effects named", named / len(mine), unit),
            figure(f"{strength} effects among those that cannot be told apart", unsure / len(mine), unit),
        ]
        either = (named + unsure) / len(mine)
        rows.append(figure(f"{strength} effects named or among those", either, unit, least=FIRST_OR_UNSURE))
    return rows


def _several(found: list[Result]) -> list[Figure]:
    mine = [outcomes.outcome(r) for r in found if len(parts(r["hidden"])) > 1 and not outside(r["hidden"])]
    return _shares("two effects", mine, {outcomes.BOTH: PAIRS})


def _outside(found: list[Result]) -> list[Figure]:
    mine = [outcomes.outcome(r) for r in found if outside(r["hidden"])]
    return _shares("outside the library", mine, {outcomes.FLAGGED: OUTSIDE})


def _coverage(found: list[Result]) -> list[Figure]:
    inside = [hit for r in found if r["hidden"] == NONE for hit in base_hits(r)]
    hits: dict[str, list[bool]] = {}
    named: list[bool] = []
    for r in found:
        for name, hit, was_named in size_hits(r) if not outside(r["hidden"]) else ():
            hits.setdefault(name, []).append(hit)
            named += [hit] * was_named
    every = [hit for own in hits.values() for hit in own]
    rows = [figure("90 % intervals of base parameters that hold the truth, nothing hidden", share(inside), "1")]
    low, high = COVERAGE
    rows += [
        figure(f"{SIZES_HOLD}, wherever fitted", share(every), f"of {len(every)}", low, high),
        figure(f"{SIZES_HOLD}, effects that were named", share(named), f"of {len(named)}"),
    ]
    return rows + [
        figure(f"intervals of {name} that hold the truth", share(own), f"of {len(own)}") for name, own in hits.items()
    ]


def _errors(found: list[Result]) -> list[Figure]:
    """With the effects that were named where they are the right ones, and of every robot that hides something."""
    hiding = [r for r in found if r["hidden"] != NONE]
    right = [r for r in hiding if outcomes.outcome(r) in (outcomes.RIGHT, outcomes.BOTH)]
    rows = []
    for which, mine, most in (("named right", right, ERROR_AFTER), ("every robot with an effect", hiding, None)):
        for key, model in VERSIONS.items():
            value = median(finite(r["errors"][key]) for r in mine)
            name = f"median error over the floor on unseen motions, {which}: {model}"
            rows.append(figure(name, value, f"of {len(mine)}", most=most if key == "added" else None))
        own = [finite(r["errors_own_floor"]["added"]) for r in mine if "errors_own_floor" in r]
        name = f"median error over these motions' own floor, {which}: {VERSIONS['added']}"
        rows.append(figure(name, median(own), f"of {len(own)}"))
    return rows


def _cost(found: list[Result]) -> list[Figure]:
    once = [r for r in found if len(parts(r["hidden"])) < 2]
    at_once = max((r["at_once"] for r in once), default=0)
    wall = f"median wall time of a diagnosis, up to {at_once} at once"
    return [
        figure(wall, median([r["wall_s"] for r in once]), "s", most=DIAGNOSIS_S),
        figure("median processor time of a diagnosis", median([r["cpu_s"] for r in once]), "s"),
        figure("greatest memory", max((r["peak_mib"] for r in found), default=math.nan), "MiB", most=MEMORY_MIB),
    ]


def _each(found: list[Result]) -> list[Figure]:
    """Every outcome of every kind of robot."""
    rows = []
    for hidden, strength in dict.fromkeys((r["hidden"], r["strength"]) for r in found):
        mine = [outcomes.outcome(r) for r in found if (r["hidden"], r["strength"]) == (hidden, strength)]
        named = "nothing hidden" if hidden == NONE else f"{hidden} ({strength})"
        rows += [figure(f"{named}: {word}", mine.count(word), f"of {len(mine)}") for word in dict.fromkeys(mine)]
    return rows


def _is_single(result: Result) -> bool:
    return len(parts(result["hidden"])) == 1 and not outside(result["hidden"])


def _shares(name: str, words: list[str], least: dict[str, float]) -> list[Figure]:
    seen = [*least, *(word for word in dict.fromkeys(words) if word not in least)] if words else []
    unit = f"of {len(words)}"
    return [figure(f"{name}: {word}", words.count(word) / len(words), unit, least=least.get(word)) for word in seen]


def share(hits: Iterable[bool]) -> float:
    """Of true ones; NaN of none."""
    return _or_nan(np.mean, list(hits))


def median(values: Iterable[float]) -> float:
    """NaN of none."""
    return _or_nan(np.median, list(values))


def _or_nan(reduce: Callable[[Any], Any], values: list[Any]) -> float:
    return float(reduce(values)) if values else math.nan
