"""What a place where the error lives is told by: a sentence, its figures, the moment that shows it, and doubts."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from tcbi_infer.compare.kinds import SCATTER

FEWEST = 25  # samples that a cell needs
LEAST_OVER, LEAST_BEYOND = 1.5, 1.15  # times the noise floor, times the error elsewhere, that are worth a sentence
AS_GOOD, SAME_SAMPLES = 0.8, 0.6  # of a cell's score, and shared by both, from which another cell may be meant as well
WHOLE = 0.95  # share of a rollout's samples that counts as all of it
Cell = tuple[str, str]  # a set of channels, a phase or condition


@dataclasses.dataclass(frozen=True)
class Moment:
    """A stretch of one channel, from sample `first` on; `inside` (span,) is where the phase holds."""

    rollout: int
    first: int
    channel: int
    inside: np.ndarray


@dataclasses.dataclass(frozen=True)
class Finding:
    """One place where the error lives.

    Attributes:
      statement: a sentence for people, computed from the data.
      score: share of the excess squared error that lies there, beyond the cell's share of the samples, 0..1; what a
        better finding covers is not counted again.
      channels: names of the channels concerned.
      phase: the phase or condition, "" for all samples.
      rms: error there, in the channels' unit; `elsewhere` the same outside the cell and of better findings, NaN if
        there is no outside.
      kind: lag, offset, droop, gain, hysteresis or scatter.
      moment: the stretch that shows it best; None if there is none.
    """

    statement: str
    score: float
    channels: tuple[str, ...]
    phase: str
    rms: float
    elsewhere: float
    over_floor: float
    kind: str = SCATTER
    moment: Moment | None = None


def doubt(
    best: Cell,
    scores: Mapping[Cell, float],
    samples: Callable[[Cell], np.ndarray],
    words: Callable[[Cell], str],
    read: set[str],
    valid: np.ndarray,
) -> str:
    """Sentences on what else may be meant where a temperature or voltage is concerned, which drifts with much else.

    Args:
      best: the cell that is told.
      scores: of all cells that may be told.
      samples: the (R, T, n) samples of a cell.
      words: for a cell.
      read: phases that a reading makes.
      valid: (R, T, n) bool: what is compared.
    """
    here, doubts = samples(best), []
    for cell in sorted(scores, key=lambda cell: -scores[cell]):
        if cell[1] == best[1] or not {cell[1], best[1]} & read or scores[cell] < AS_GOOD * scores[best]:
            continue
        there = samples(cell)
        if np.sum(here & there) >= SAME_SAMPLES * np.sum(here | there):
            doubts.append(
                f" Nearly the same samples ({words(cell)}) err as much: "
                "these recordings cannot tell which is behind it."
            )
            break
    if best[1] in read:
        rollouts = valid.any(axis=(1, 2))
        of_these = valid & (here.any(axis=(0, 1)))  # the channels of the cell
        share = here.sum(axis=(1, 2))[rollouts] / np.maximum(of_these.sum(axis=(1, 2))[rollouts], 1)
        if np.all((share > WHOLE) | (share < 1 - WHOLE)):
            doubts.append(" These are whole rollouts: whatever else differed between them may be behind it.")
    return "".join(doubts)
