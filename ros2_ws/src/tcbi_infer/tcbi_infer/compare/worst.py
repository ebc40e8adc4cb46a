"""The moments in which a prediction departs most from what was measured: of joints, attitude and rates."""

import dataclasses
from typing import Any

import numpy as np

from tcbi_infer.compare.locate import MOMENT_S, worst_moments
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import ATTITUDE, JOINT, RATE

MOMENTS = 10  # that are told


@dataclasses.dataclass(frozen=True)
class WorstMoment:
    """A stretch of one signal.

    Attributes:
      rollout: its id; of repeats the first one.
      time: s since the rollout's begin at which it begins; `until` ends it.
      error: root mean square over it, in `unit`.
      index: rollout, first sample and channel of the comparison's arrays.
    """

    rollout: str
    time: float
    until: float
    signal: str
    unit: str
    error: float
    error_over_floor: float
    index: tuple[int, int, int]

    def to_json(self) -> dict[str, Any]:
        """All but the index."""
        return {k: v for k, v in dataclasses.asdict(self).items() if k != "index"}


def worst(replay: Replay, predicted: np.ndarray, floor: np.ndarray, count: int = MOMENTS) -> list[WorstMoment]:
    """The worst stretches, apart from each other; replicates would show the same ones again.

    Args:
      replay: what was measured.
      predicted: (R, T, C).
      floor: (C,).
      count: at most.
    """
    layout = replay.layout
    span = min(len(replay.time), round(MOMENT_S * layout.rate))
    firsts = [g.members[0] for g in replay.replicates]
    residual = (replay.measured - predicted)[firsts]
    found = []
    for s, t, c in worst_moments(residual, floor, layout.where(JOINT, ATTITUDE, RATE), count, span):
        window = residual[s, t : t + span, c]
        error = float(np.sqrt(np.nanmean(window**2)))
        channel, begin, end = layout.channels[c], replay.time[t], replay.time[t + len(window) - 1]
        found.append(
            WorstMoment(
                replay.measurements[firsts[s]].rollout_id, float(begin), float(end), channel.name, channel.group.unit,
                error, error / float(floor[c]), (firsts[s], t, c),
            )
        )  # fmt: skip
    return found
