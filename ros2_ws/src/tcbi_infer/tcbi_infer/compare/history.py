"""The error of every model version, on rollouts that no fit has seen."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from tcbi_contract.files import replace_file
from tcbi_contract.plain import plain
from tcbi_infer.compare.comparison import error_figure
from tcbi_infer.compare.ladder import not_seen, seen_by
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.scorer import diverged
from tcbi_infer.compare.timestep import fine_step
from tcbi_infer.seen import used_before
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model

PREFIX = "history-"  # file of a rig: the errors of its versions as they were last measured


@dataclasses.dataclass(frozen=True)
class VersionError:
    """One line of the history.

    Attributes:
      error_over_floor: None where nothing unseen was measured.
      rollouts: those it was measured on; empty where the figure was kept from the diagnosis that made the version.
      floor_from_replicates: None where the figure was kept and does not say.
    """

    model: str
    parent: str | None
    effects: tuple[str, ...]
    error_over_floor: float | None
    rollouts: tuple[str, ...] = ()
    floor_from_replicates: bool | None = None


def history(models: Sequence[Model], measurements: Sequence[Measurement] = ()) -> list[VersionError]:
    """The error of each version.

    With measurements every version is compared on the same rollouts, over the same floor: those that no version was
    fitted to, and that repeat none that one was. Without, the figures are those that the diagnoses kept: of the
    versions they made, and of the versions they began with, unless one of those had been fitted to the same rollouts.
    """
    seen = {r for m in models for r in used_before(m)}
    unseen = not_seen(measurements, seen)
    if not unseen:
        kept = [_kept(m, models) for m in models]
        return [
            VersionError(m.version, m.parent, m.effects, error, floor_from_replicates=repeated)
            for m, (error, repeated) in zip(models, kept, strict=True)
        ]
    replay = Replay.of(models[0], unseen)
    names = tuple(m.rollout_id for m in replay.measurements)
    floor = common_floor(models, replay)
    step = min(fine_step(replay, m, floor.values) for m in (models[0], models[-1]))
    errors = [error_figure(m, unseen, timestep=step, floor=floor) for m in models]
    return [
        VersionError(m.version, m.parent, m.effects, error, names, floor.from_replicates)
        for m, error in zip(models, errors, strict=True)
    ]


def remember(lines: Sequence[VersionError], folder: Path, rig: str, not_counted: Sequence[str] = ()) -> Path:
    """Keep what was measured last, for the dashboard.

    Args:
      lines: of all versions, measured on the same rollouts.
      folder: `runs` of the store.
      rig: of the versions.
      not_counted: rollouts that were given too, but that a fit has seen.
    """
    content = {
        "rig": rig,
        "given": len(lines[0].rollouts) + len(not_counted),
        "not_counted": list(not_counted),
        "lines": [dataclasses.asdict(line) for line in lines],
    }
    path = folder / f"{PREFIX}{rig}.json"
    replace_file(path, json.dumps(plain(content)))
    return path


def unseen_error(model: Model) -> float | None:
    """The error that the diagnosis which made a version kept, unless it is that of the very motions of the fit."""
    return None if model.evidence.get("nothing_held_out") else model.evidence.get("error_over_floor")


def common_floor(models: Sequence[Model], replay: Replay) -> NoiseFloor:
    """One for several versions: from repeats, else from the residual of the first one that predicts every rollout."""
    residual = replay.measured
    for model in models:
        predicted = replay.by_rollout(replay.predict(model, model.mean()[None])[0])
        residual = replay.measured - predicted
        if not diverged(replay.layout, replay.measured, predicted).any():
            break
    return replay.noise_floor(residual)


def _kept(model: Model, models: Sequence[Model]) -> tuple[float | None, bool | None]:
    """A version's kept error, and whether its floor is from replicates; None where that is not known."""
    if (own := unseen_error(model)) is not None:
        return own, model.evidence.get("floor_from_replicates")
    for child in models:
        evidence = child.evidence
        if child.parent == model.version and "unfitted" in evidence.get("errors", {}):
            judged_on = set(evidence.get("sealed") or evidence.get("rollouts", ()))
            if not judged_on & seen_by(model, models):
                return evidence["errors"]["unfitted"], evidence.get("floor_from_replicates")
    return None, None
