"""Two versions of a model side by side, and what removing an effect does to the distribution of the others.

difference = compare_versions(store.load("hexapod-v1"), store.load("hexapod-v3"))
difference.statement, difference.parameters
"""

import dataclasses
from typing import Any

import numpy as np

from tcbi_infer.compare.history import unseen_error
from tcbi_infer.errors import InferError
from tcbi_infer.seen import used_before
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

LINKED = 0.3  # correlation from which on a parameter is said to have been fitted together with another


@dataclasses.dataclass(frozen=True)
class Interval:
    """A parameter in one version: mean and 90 % interval under its particles, in the parameter's unit."""

    mean: float
    low90: float
    high90: float


@dataclasses.dataclass(frozen=True)
class ParameterChange:
    """A parameter before and after; None in a version that does not have it.

    Attributes:
      overlap: share of the shorter 90 % interval that lies in the other one, 0 to 1, on the parameter's own scale.
      width_ratio: width of the interval after over that before, on the same scale.
    """

    name: str
    unit: str
    before: Interval | None
    after: Interval | None
    overlap: float | None
    width_ratio: float | None


@dataclasses.dataclass(frozen=True)
class Grounds:
    """What a version rests on.

    Attributes:
      kind: what made it, as `Model.made_by`.
      rollouts: that it was fitted to.
      error_over_floor: on rollouts that its fit had not seen; None where nothing was measured.
      joint_gains: each servo's own stiffness, in words.
    """

    kind: str
    statement: str
    accepted: bool | None
    rollouts: tuple[str, ...]
    error_over_floor: float | None
    joint_gains: str


@dataclasses.dataclass(frozen=True)
class Difference:
    """Two versions of one rig's model."""

    before: str
    after: str
    effects_added: tuple[str, ...]
    effects_removed: tuple[str, ...]
    parameters: tuple[ParameterChange, ...]
    grounds_before: Grounds
    grounds_after: Grounds
    rollouts_shared: int
    statement: str


def compare_versions(before: Model, after: Model) -> Difference:
    """What differs between two versions.

    Raises:
      InferError: they are of different rigs.
    """
    if before.rig != after.rig:
        raise InferError(
            f"{before.version} is a model of {before.rig}, {after.version} of {after.rig}; "
            "give two versions of one rig (./tcbi model lists them)"
        )
    added = tuple(e for e in after.effects if e not in before.effects)
    removed = tuple(e for e in before.effects if e not in after.effects)
    first, second = (intervals(m) | {name: Interval(v, v, v) for name, v in m.fixed.items()} for m in (before, after))
    known = {p.name: p for p in (*before.parameters, *after.parameters)}
    changes = tuple(_change(p, first.get(p.name), second.get(p.name)) for p in known.values())
    grounds = grounds_of(before), grounds_of(after)
    shared = len(set(grounds[0].rollouts) & set(grounds[1].rollouts))
    statement = _statement(before, after, added, removed, changes)
    return Difference(before.version, after.version, added, removed, changes, *grounds, shared, statement)


def marginal_evidence(parent: Model, use: str) -> dict[str, Any]:
    """What a version says of itself that an effect was removed from: evidence for `Model.evidence`.

    The joint posterior is marginalised over the effect's own parameters. Parameters that went with them in the joint
    distribution keep what they took from the effect, so they are named.
    """
    fitted = used_before(parent)
    linked = linked_parameters(parent, use) if fitted else {}
    words = (
        f"{use} was removed from {parent.version}; the other parameters keep their joint distribution, marginalised "
        "over it."
    )
    if not fitted:
        words += " None of them has been fitted to any rollout."
    elif linked:
        words += (
            f" They were fitted beside it ({', '.join(f'{n}: correlation {r:+.2f}' for n, r in linked.items())}), so "
            "without it they are no fit: fit again before trusting them."
        )
    else:
        words += " None of them went with it, but nothing has been fitted without it either: measure the error."
    return {
        "kind": "remove",
        "use": use,
        "statement": words,
        "linked": linked,
        "rollouts": sorted(fitted),
    }


def linked_parameters(model: Model, use: str) -> dict[str, float]:
    """Other parameters of a model with their strongest correlation with one of an effect's, beyond `LINKED`."""
    unit, weights = model.to_unit(model.particles), model.weights
    deviation = unit - weights @ unit
    covariance = (deviation * weights[:, None]).T @ deviation
    spread = np.sqrt(np.diag(covariance))
    own = [i for i, name in enumerate(model.names) if name.startswith(f"{use}.")]
    linked = {}
    for i, name in enumerate(model.names):
        if i in own or spread[i] == 0:
            continue
        found = [covariance[i, j] / (spread[i] * spread[j]) for j in own if spread[j] > 0]
        strongest = max(found, key=abs, default=0.0)
        if abs(strongest) > LINKED:
            linked[name] = float(strongest)
    return linked


def intervals(model: Model) -> dict[str, Interval]:
    """Mean and 90 % interval of each parameter under the model's particles."""
    result = {}
    for p, values, mean in zip(model.parameters, model.particles.T, model.mean(), strict=True):
        order = np.argsort(values)
        reached = np.cumsum(model.weights[order])
        low, high = (float(values[order][min(np.searchsorted(reached, q), len(values) - 1)]) for q in (0.05, 0.95))
        result[p.name] = Interval(float(mean), low, high)
    return result


def grounds_of(model: Model) -> Grounds:
    """What a version rests on."""
    e, inference = model.evidence, model.evidence.get("inference")
    statement = e.get("statement", "")
    if inference:
        statement = f"{inference['method']}, effective sample size {inference['ess']:.0f}"
    rollouts = tuple(sorted(used_before(model)))
    return Grounds(model.made_by, statement, e.get("accepted"), rollouts, unseen_error(model), model.joint_gains_told)


def _change(p: Parameter, before: Interval | None, after: Interval | None) -> ParameterChange:
    if before is None or after is None:
        return ParameterChange(p.name, p.unit, before, after, None, None)
    a, b = (np.array([p.to_unit(i.low90), p.to_unit(i.high90)], float) for i in (before, after))
    inside = min(a[1], b[1]) - max(a[0], b[0])
    shorter = min(a[1] - a[0], b[1] - b[0])
    overlap = float(inside >= 0) if shorter <= 0 else float(np.clip(inside / shorter, 0.0, 1.0))
    ratio = float((b[1] - b[0]) / (a[1] - a[0])) if a[1] > a[0] else None
    return ParameterChange(p.name, p.unit, before, after, overlap, ratio)


def _statement(
    first: Model, second: Model, added: tuple[str, ...], removed: tuple[str, ...], changes: tuple[ParameterChange, ...]
) -> str:
    before, after = first.version, second.version
    parts = [f"{after} has {', '.join(added)}, which {before} has not"] if added else []
    parts += [f"{after} lacks {', '.join(removed)}"] if removed else []
    parts = parts or [f"{before} and {after} have the same effects"]
    parts += [f"fixed is {m.fixed_told} in {m.version}" for m in (first, second) if first.fixed != second.fixed]
    fitted = [c for c in changes if c.name in first.names and c.name in second.names]
    apart = [c.name for c in fitted if c.overlap == 0]
    narrower = [c.name for c in fitted if c.width_ratio is not None and c.width_ratio < 0.5]
    if apart:
        parts.append(f"the 90 % intervals of {', '.join(apart)} do not overlap")
    if narrower:
        which = f"intervals of {', '.join(narrower)} are" if len(narrower) > 1 else f"interval of {narrower[0]} is"
        parts.append(f"the 90 % {which} less than half as wide as in {before}")
    return "; ".join(parts) + "."
