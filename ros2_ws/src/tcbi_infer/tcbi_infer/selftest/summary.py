"""What a self-test says as a whole: by effect what was found, and whether that is good enough."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from scipy.special import betaincinv

from tcbi_contract.wording import counted
from tcbi_infer.selftest.trial import FALSE_ALARM, MISSED, RIGHT, UNSURE, WRONG, Result


@dataclasses.dataclass(frozen=True)
class Limits:
    """What is still good enough.

    Attributes:
      missed: strong effects that may be missed or taken for another one; weak ones where only these were planted.
      false_alarms: robots with nothing planted in which something may be found.
      unsure: whether an honest "cannot tell" that names the planted effect among others is good enough.
    """

    missed: int = 0
    false_alarms: int = 0
    unsure: bool = True


@dataclasses.dataclass(frozen=True)
class Summary:
    """The outcome of a self-test.

    Attributes:
      rows: by what was planted and how strongly: counts of each outcome.
      faults: why it does not pass, in sentences.
      claim: what so many robots say of the false-alarm rate, in a sentence.
    """

    rows: tuple[dict[str, Any], ...]
    faults: tuple[str, ...]
    claim: str

    @property
    def passed(self) -> bool:
        """Whether it is good enough."""
        return not self.faults

    def to_json(self) -> dict[str, Any]:
        """Keys as in the attributes."""
        return {"passed": self.passed, **dataclasses.asdict(self)}


def summarise(results: Sequence[Result], limits: Limits) -> Summary:
    """Counts, and what is not good enough."""
    rows = []
    for key in dict.fromkeys((r["effect"], r["strength"]) for r in results):
        mine = [r for r in results if (r["effect"], r["strength"]) == key]
        counts = {word: sum(r["outcome"] == word for r in mine) for word in (RIGHT, UNSURE, WRONG, MISSED, FALSE_ALARM)}
        rows.append({"effect": key[0] or "nothing", "strength": key[1], "robots": len(mine), **counts})
    bad = (WRONG, MISSED) if limits.unsure else (WRONG, MISSED, UNSURE)
    judged = "strong" if any(r["strength"] == "strong" for r in results) else "weak"
    missed = [r for r in results if r["strength"] == judged and r["outcome"] in bad]
    alarms = [r for r in results if r["outcome"] == FALSE_ALARM]
    faults = []
    if len(missed) > limits.missed:
        names = ", ".join(dict.fromkeys(f"{r['use']} ({r['outcome']})" for r in missed))
        faults.append(f"{len(missed)} {judged} effects were not found, allowed are {limits.missed}: {names}")
    if len(alarms) > limits.false_alarms:
        told = "; ".join(dict.fromkeys(", ".join(r["uses"]) or r["verdict"] for r in alarms))
        faults.append(f"{len(alarms)} false alarms, allowed are {limits.false_alarms}: {told}")
    return Summary(tuple(rows), tuple(faults), _claim(len(alarms), sum(not r["use"] for r in results)))


def _claim(alarms: int, robots: int) -> str:
    if not robots:
        return "No robot without an effect was tried, so nothing is said of false alarms."
    most = float(betaincinv(alarms + 1, robots - alarms, 0.95)) if alarms < robots else 1.0
    return (
        f"{counted(alarms, 'false alarm')} in {counted(robots, 'robot')} with nothing planted leave room for a rate of "
        f"up to {100 * most:.0f} % (one-sided, 95 %)."
    )
