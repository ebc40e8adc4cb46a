"""The errors of a rig's versions from one source: which version has a figure there, and what must be said of it.

The source is the last measurement on rollouts that no fit had seen; without one, the diagnosis that made the newest
version. Figures of two sources are never put side by side.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from tcbi_dashboard.charts import number
from tcbi_sim.model import Model

FLOOR = {
    True: "1 is the robot against itself",
    False: "1 is the estimated noise, since none of these motions was repeated",
    None: "1 is the noise floor",
}
AGAIN = "choose rollouts that no fit has seen, then measure all versions again"


@dataclasses.dataclass(frozen=True)
class Point:
    """One version: its error over the noise floor, or in a few words why it has none here."""

    model: str
    parent: str | None
    error: float | None
    why_none: str = ""
    seen: bool = False  # its fit has seen the rollouts


@dataclasses.dataclass(frozen=True)
class ErrorLine:
    """Every version, what the figures were measured on, and what else a reader must know.

    Attributes:
      source: "" where no version has a figure.
      used: rollouts that it was measured on; none where the figures are a diagnosis's.
      not_counted: rollouts that were chosen, but that a fit had seen.
    """

    points: tuple[Point, ...]
    source: str = ""
    notes: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    not_counted: tuple[str, ...] = ()


def error_line(models: Sequence[Model], record: Mapping[str, Any] | None) -> ErrorLine:
    """The errors of versions, oldest first, from one source; `record` is the last measurement."""
    measured = record and _measured(models, record)
    return measured or _diagnosed(models)


def _measured(models: Sequence[Model], record: Mapping[str, Any]) -> ErrorLine | None:
    from tcbi_infer.compare.ladder import seen_by  # takes a third of a second to load

    lines = {line["model"]: line for line in record["lines"] if line["rollouts"]}
    if not lines:
        return None
    some = next(iter(lines.values()))
    used, given = tuple(some["rollouts"]), int(record["given"])
    points = []
    for m in models:
        fitted = len(seen_by(m, models) & set(used))
        line = lines.get(m.version)
        if fitted:
            points.append(Point(m.version, m.parent, None, f"its fit has seen {fitted} of these rollouts", True))
        elif line is None or line["parent"] != m.parent:
            points.append(Point(m.version, m.parent, None, "not measured on these rollouts"))
        else:
            points.append(Point(m.version, m.parent, line["error_over_floor"]))
    if all(p.error is None for p in points):
        return None
    unseen = (
        "that no fit has seen" if not any(p.seen for p in points) else "that the fits of these versions have not seen"
    )
    count = f"{len(used)} rollout{'s' * (len(used) != 1)}"
    notes = []
    if given > len(used):
        seen = given - len(used)
        were = "was seen by a fit and does" if seen == 1 else "were seen by a fit and do"
        notes.append(f"{seen} of the {given} chosen {were} not count.")
    return ErrorLine(
        tuple(points),
        f"Measured on {count} {unseen}; {FLOOR[some['floor_from_replicates']]}.",
        (*notes, *_missing(points), *_rises(points)),
        used,
        tuple(record.get("not_counted", ())),
    )


def _diagnosed(models: Sequence[Model]) -> ErrorLine:
    """The figures of one diagnosis: of the newest version that one made, and of the version that it began with."""
    from tcbi_infer.compare.ladder import seen_by

    made = [m for m in models if m.evidence.get("kind") == "diagnosis" and _finite(m.evidence.get("error_over_floor"))]
    if not made:
        return ErrorLine(tuple(Point(m.version, m.parent, None, "not measured") for m in models))
    newest = made[-1]
    e = newest.evidence
    figures = {m.version: m.evidence["error_over_floor"] for m in made if same_diagnosis(m, newest)}
    parent = next((m for m in models if m.version == newest.parent), None)
    judged_on = set(e.get("sealed") or e.get("rollouts", ()))
    if parent and _finite(e.get("errors", {}).get("unfitted")) and not judged_on & seen_by(parent, models):
        figures[parent.version] = e["errors"]["unfitted"]
    points = [
        Point(m.version, m.parent, figures.get(m.version), "" if m.version in figures else "not measured there")
        for m in models
    ]
    motions = "the motion of the fit itself" if e.get("nothing_held_out") else "motions that its fits had not seen"
    source = f"From the diagnosis that made {newest.version}, on {motions}; {FLOOR[e.get('floor_from_replicates')]}."
    return ErrorLine(tuple(points), source, (*_missing(points), *_rises(points)))


def same_diagnosis(one: Model, other: Model) -> bool:
    """Whether one and the same diagnosis made two versions."""
    return one.parent == other.parent and _mark(one.evidence) == _mark(other.evidence)


def made_before(models: Sequence[Model], diagnosis: Mapping[str, Any], use: str) -> tuple[list[str], list[str]]:
    """Versions with the diagnosed one as parent and this effect added: from this very diagnosis, and from others."""
    same: list[str] = []
    others: list[str] = []
    for m in models:
        if m.parent == diagnosis["model"] and m.evidence.get("kind") == "diagnosis" and m.evidence.get("use") == use:
            (same if _mark(m.evidence) == _mark(diagnosis) else others).append(m.version)
    return same, others


def _mark(evidence: Mapping[str, Any]) -> tuple:
    """What tells one diagnosis from another: its rollouts and the errors before any effect was added."""
    errors = evidence.get("errors", {})
    sealed = set(evidence.get("sealed", ()))
    fitted = tuple(sorted(set(evidence.get("rollouts", ())) - sealed))
    return fitted, tuple(sorted(sealed)), errors.get("unfitted"), errors.get("base")


def _missing(points: Sequence[Point]) -> list[str]:
    """Each reason why versions have no figure, with the versions and what to do."""
    reasons: dict[str, list[str]] = {}
    for p in points:
        if p.error is None:
            reasons.setdefault(p.why_none, []).append(p.model)
    return [f"{', '.join(names)}: {reason}; {AGAIN}." for reason, names in reasons.items()]


def _rises(points: Sequence[Point]) -> list[str]:
    """Versions that are worse than what they were made from."""
    errors = {p.model: p.error for p in points}
    said = []
    for p in points:
        before = errors.get(p.parent or "")
        if p.error is not None and before is not None and p.error > before:
            said.append(
                f"{p.model} errs more than its parent {p.parent} here: {number(p.error)} against {number(before)}."
            )
    return said


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)
