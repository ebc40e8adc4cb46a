"""The error ladder: noise floor, base model, each added effect, and what remains unexplained."""

import dataclasses
import re
from collections.abc import Collection, Sequence

import numpy as np

from tcbi_infer.compare.comparison import Comparison, error_figure
from tcbi_infer.compare.replicates import repeats
from tcbi_infer.seen import used_before
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model

UNFITTED = "base model, not fitted"  # at the middle of its parameters' ranges
PIECE = re.compile(r"-\d{2,}$")  # what the id of a piece has behind that of its recording


@dataclasses.dataclass(frozen=True)
class Rung:
    """One version on the way from the base model to the one compared.

    Attributes:
      fitted_here: whether it, or one that it comes from, was fitted to some of these rollouts.
    """

    model: str
    label: str
    error_over_floor: float
    fitted_here: bool


def lineage(model: Model, models: Sequence[Model]) -> list[Model]:
    """A version and those that it comes from, oldest first, as far as they are among `models`."""
    known = {m.version: m for m in models}
    line = [model]
    while line[0].parent in known and known[line[0].parent] not in line:
        line.insert(0, known[line[0].parent])
    return line


def seen_by(model: Model, models: Sequence[Model]) -> set[str]:
    """The rollouts that a version or one that it comes from was fitted to."""
    return {r for m in lineage(model, models) for r in used_before(m)}


def was_seen(m: Measurement, seen: Collection[str]) -> bool:
    """Whether a rollout is among those seen, or is of a log (a piece or all of it) of which anything else was."""
    logs = {*seen, *(PIECE.sub("", r) for r in seen)}
    piece = m.scenario.initial_joint_velocity is not None
    return m.rollout_id in logs or (piece and PIECE.sub("", m.rollout_id) in logs)


def not_seen(measurements: Sequence[Measurement], seen: Collection[str]) -> list[Measurement]:
    """Rollouts that are not among those seen and repeat none of them, as far as these are among `measurements`."""
    known = {i for i, m in enumerate(measurements) if was_seen(m, seen)}
    known |= {i for group in repeats(measurements) if known & set(group) for i in group}
    return [m for i, m in enumerate(measurements) if i not in known]


def ladder(comparison: Comparison, line: Sequence[Model], measurements: Sequence[Measurement]) -> tuple[Rung, ...]:
    """The error of each version on the same rollouts, over the same floor, with the same time step.

    Args:
      comparison: of the last version.
      line: versions, oldest first, as `lineage` gives them.
      measurements: the rollouts compared.
    """
    rungs = []
    for before, model in zip([None, *line], line, strict=False):
        error = (
            comparison.error_over_floor
            if model.version == comparison.model
            else error_figure(model, measurements, timestep=comparison.timestep, floor=comparison.floor)
        )
        seen = seen_by(model, line)
        fitted = any(was_seen(m, seen) for m in comparison.replay.measurements)
        rungs.append(Rung(model.version, label(model, before), error, fitted))
    return tuple(rungs)


def label(model: Model, before: Model | None) -> str:
    """A version and what it has that the one before has not."""
    if before is None:
        return f"{model.version}: {', '.join(model.effects) or ('base model' if model.parent else UNFITTED)}"
    added = [e for e in model.effects if e not in before.effects]
    removed = [e for e in before.effects if e not in model.effects]
    words = [f"with {', '.join(added)}"] if added else []
    words += [f"without {', '.join(removed)}"] if removed else []
    return f"{model.version}: {', '.join(words) or 'other parameter values'}"


def unexplained(error_over_floor: float) -> float:
    """What remains beyond the noise, in multiples of the floor: squares add up, so 1 leaves 0."""
    return float(np.sqrt(max(error_over_floor**2 - 1.0, 0.0))) if np.isfinite(error_over_floor) else float("nan")


def explained(base: float, last: float) -> float:
    """Share of the base model's squared error beyond the floor that the last version no longer has; NaN without any.

    Also NaN where one of the two diverged: of an infinite error there are no shares.
    """
    excess = base**2 - 1.0
    told = excess > 0 and np.isfinite([base, last]).all()
    return float(1.0 - max(last**2 - 1.0, 0.0) / excess) if told else float("nan")
