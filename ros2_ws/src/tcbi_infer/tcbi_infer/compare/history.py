"""The error of every model version, on rollouts that no fit has seen."""

import dataclasses
from collections.abc import Sequence

from tcbi_infer.compare.comparison import compare
from tcbi_infer.seen import used_before
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model


@dataclasses.dataclass(frozen=True)
class VersionError:
    """One line of the history.

    Attributes:
      error_over_floor: None where nothing unseen was measured.
      rollouts: those it was measured on; empty where the figure was kept from the diagnosis that made the version.
    """

    model: str
    parent: str | None
    effects: tuple[str, ...]
    error_over_floor: float | None
    rollouts: tuple[str, ...] = ()


def history(models: Sequence[Model], measurements: Sequence[Measurement] = ()) -> list[VersionError]:
    """The error of each version.

    With measurements every version is compared on the same rollouts: those that no version was fitted to. Without,
    the figures are those that the diagnoses kept: of the versions they made, and of the versions they began with.
    """
    seen = {r for m in models for r in used_before(m)}
    unseen = [m for m in measurements if m.rollout_id not in seen]
    names = tuple(m.rollout_id for m in unseen)
    result = []
    for model in models:
        if unseen:
            error: float | None = compare(model, unseen, particles=0).error_over_floor
        else:
            error = _kept(model, models)
        result.append(VersionError(model.version, model.parent, model.effects, error, names))
    return result


def _kept(model: Model, models: Sequence[Model]) -> float | None:
    if "error_over_floor" in model.evidence:
        return model.evidence["error_over_floor"]
    for child in models:
        if child.parent == model.version and "unfitted" in child.evidence.get("errors", {}):
            return child.evidence["errors"]["unfitted"]
    return None
