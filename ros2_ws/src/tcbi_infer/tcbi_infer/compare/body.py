"""Where the body's signals err: attitude, rates and contacts, beside the joints; by phases of the whole robot.

They stand apart from the joints: tilt that the joints do not explain points at sensors, ground or mass.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from tcbi_infer.compare.conditions import MOVING, STILL, Condition
from tcbi_infer.compare.findings import FEWEST, LEAST_BEYOND, LEAST_OVER, Finding, Moment, doubt
from tcbi_infer.compare.kinds import OFFSET, SCATTER
from tcbi_infer.compare.signals import ATTITUDE, CONTACT, JOINT, RATE, Group, Layout

CONSTANT = 0.6  # share of the squared error from which it counts as an offset
WORST = 0.15  # share of the excess error, beyond its share of the samples, from which a phase is told
VERBS = {ATTITUDE: "body attitude departs", RATE: "body rates depart", CONTACT: "foot contacts depart"}


@dataclasses.dataclass(frozen=True)
class Whole:
    """Phases of the robot as a whole: (R, T) bool by the words for them, and which of them readings make."""

    masks: Mapping[str, np.ndarray]
    read: set[str]

    @staticmethod
    def of(joints: Mapping[str, np.ndarray], conditions: Sequence[Condition], shape: tuple[int, ...]) -> "Whole":
        """From the (R, T, J) phases and the conditions of joints: standing still is that of all, moving of any.

        Args:
          joints: phases of joints.
          conditions: numbers of joints; a robot has their mean.
          shape: R, T.
        """
        masks: dict[str, np.ndarray] = {}
        if STILL in joints:
            still = np.asarray(joints[STILL].all(axis=-1))
            masks = {STILL: still, MOVING: ~still}
        read: set[str] = set()
        for condition in conditions:
            known = np.isfinite(condition.values)
            count = known.sum(axis=-1, keepdims=True)
            total = np.where(known, condition.values, 0.0).sum(axis=-1, keepdims=True)
            mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
            whole = dataclasses.replace(condition, values=mean)
            if whole.varies:
                parts = {words: np.broadcast_to(part[..., 0], shape) for words, part in whole.parts().items()}
                masks |= parts
                read |= set(parts) if condition.reading else set()
        return Whole(masks, read)


def body_findings(layout: Layout, residual: np.ndarray, floor: np.ndarray, whole: Whole, span: int) -> list[Finding]:
    """Groups of the body's signals that stand above the joints, each with its worst phase and moment.

    None where the prediction diverged in every rollout.

    Args:
      layout: the channels.
      residual: (R, T, C) measured less predicted, NaN where missing.
      floor: (C,) noise floor.
      whole: phases of the robot.
      span: samples of a moment.
    """
    if not np.isfinite(residual[..., layout.where(JOINT)]).any():
        return []
    over_joint = _over(residual, floor, layout.where(JOINT))
    findings = []
    for group in VERBS:
        index = layout.where(group)
        if not len(index) or not np.isfinite(residual[..., index]).any():
            continue
        over = _over(residual, floor, index)
        if over >= LEAST_OVER and over >= LEAST_BEYOND * over_joint:
            findings.append(_finding(group, layout, residual[..., index], floor[index], whole, span, over_joint))
    return findings


def _finding(
    group: Group,
    layout: Layout,
    error: np.ndarray,
    floor: np.ndarray,
    whole: Whole,
    span: int,
    over_joint: float,
) -> Finding:
    """The sentence of one group from its (R, T, n) errors and (n,) floors."""
    index = layout.where(group)
    valid = np.isfinite(error)
    square = np.where(valid, np.nan_to_num(error) ** 2, 0.0)
    count = np.maximum(valid.sum(axis=(0, 1)), 1)
    mean = np.where(valid, error, 0.0).sum(axis=(0, 1)) / count
    constant = float(np.sum(mean**2) / np.sum(square.sum(axis=(0, 1)) / count)) > CONSTANT
    rms, over = _rms(square[valid]), _rms((square / floor**2)[valid])
    text = (
        f"The {VERBS[group]} from the prediction by {_size(rms, group)}, {over:.1f} times the noise floor"
        f"{', mostly a constant offset' * constant}, while the joints stand at {over_joint:.1f} times theirs."
    )
    excess = np.maximum(square / floor**2 - 1.0, 0.0) * valid
    scores = {("", phase): _score(mask, excess, valid) for phase, mask in whole.masks.items()}
    best = max(scores, key=lambda cell: scores[cell], default=("", ""))
    mask, phase, elsewhere = np.ones(error.shape[:2], bool), "", float("nan")
    if scores.get(best, 0.0) >= WORST:
        mask, phase = whole.masks[best[1]], best[1]
        rms, elsewhere = (_rms(square[part][valid[part]]) for part in (mask, ~mask))
        over = _rms((square / floor**2)[mask][valid[mask]])
        text += f" It is worst {phase}: {_size(rms, group)}; elsewhere {_size(elsewhere, group)}."
        text += doubt(
            best, scores, lambda cell: whole.masks[cell[1]][..., None] & valid, lambda cell: cell[1], whole.read, valid
        )
    over_all = float(np.sqrt((square / floor**2).sum() / valid.sum()))
    return Finding(
        statement=text,
        score=float(min(1.0, 1.0 - over_joint**2 / over_all**2)),
        channels=tuple(layout.channels[i].name for i in index),
        phase=phase,
        rms=rms,
        elsewhere=elsewhere,
        over_floor=over,
        kind=OFFSET if constant else SCATTER,
        moment=_moment(index, excess, mask, span),
    )


def _score(mask: np.ndarray, excess: np.ndarray, valid: np.ndarray) -> float:
    """Share of the excess error that a phase (R, T) holds, beyond its share of the samples; none of too few."""
    inside, everything, total = int(valid[mask].sum()), int(valid.sum()), float(excess.sum())
    if not FEWEST <= inside <= everything - FEWEST or total <= 0:
        return 0.0
    return float(excess[mask].sum() / total - inside / everything)


def _moment(index: np.ndarray, excess: np.ndarray, mask: np.ndarray, span: int) -> Moment:
    """The stretch of one channel that holds most of the excess error inside a phase."""
    worst = np.where(mask[..., None], excess, 0.0)
    total = np.cumsum(np.concatenate([np.zeros_like(worst[:, :1]), worst], axis=1), axis=1)
    windows = total[:, span:] - total[:, :-span]
    r, t, c = (int(i) for i in np.unravel_index(int(np.argmax(windows)), windows.shape))
    return Moment(r, t, int(index[c]), mask[r, t : t + span])


def _size(rms: float, group: Group) -> str:
    return f"{rms:.2f} of a contact" if group is CONTACT else f"{rms:.2f} {group.unit}"


def _over(residual: np.ndarray, floor: np.ndarray, index: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean((residual[..., index] / floor[index]) ** 2)))


def _rms(squares: np.ndarray) -> float:
    """Root of the mean; NaN of nothing."""
    return float(np.sqrt(squares.mean())) if squares.size else float("nan")
