"""Where the error lives, as maps: joint x phase of the motion, and error against load, speed, slope and more.

All errors are root mean squares over the noise floor, so that 1 is as good as any model can be.
"""

import dataclasses

import numpy as np

from tcbi_infer.compare.comparison import Comparison
from tcbi_infer.compare.conditions import conditions, phases
from tcbi_infer.compare.findings import FEWEST
from tcbi_infer.compare.signals import DEGREE, JOINT
from tcbi_sim.rigs import load_rig

BINS = 8


@dataclasses.dataclass(frozen=True)
class Heat:
    """Error over noise floor of each joint in each phase; NaN where a cell has too few samples."""

    joints: tuple[str, ...]
    phases: tuple[str, ...]
    values: np.ndarray  # (phases, joints)
    worst: np.ndarray  # (phases, joints, 2) rollout and sample at which the error of a cell is largest


@dataclasses.dataclass(frozen=True)
class Curve:
    """Error over noise floor against one condition, all joints together.

    Attributes:
      middle: (n,) of each bin, in `unit`; bins hold equally many samples, or one value each where there are few.
      error: (n,).
    """

    condition: str
    unit: str
    middle: np.ndarray
    error: np.ndarray


def joint_errors(comparison: Comparison) -> dict[str, float]:
    """Error over noise floor of each joint, all rollouts together."""
    joints = set(comparison.replay.layout.joint_names)
    return {s.name: s.ratio for s in comparison.signals if s.name in joints}


def heat(comparison: Comparison) -> Heat:
    """Joint x phase; a phase that no joint is ever in is left out."""
    scaled = _scaled(comparison)
    replay = comparison.replay
    rig = load_rig(replay.rig)
    predicted = comparison.predicted[..., replay.layout.where(JOINT)] / DEGREE
    each = [
        {"at any time": np.ones(scaled.shape[1:], bool), **phases(rig, m, replay.time, q)}
        for m, q in zip(replay.measurements, predicted, strict=True)
    ]
    names = list(dict.fromkeys(name for masks in each for name in masks))
    rows, worst = [], []
    for name in names:
        mask = np.stack([masks.get(name, np.zeros(scaled.shape[1:], bool)) for masks in each]) & np.isfinite(scaled)
        count = mask.sum(axis=(0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            row = np.sqrt(np.where(mask, scaled**2, 0.0).sum(axis=(0, 1)) / count)
        rows.append(np.where(count >= FEWEST, row, np.nan))
        largest = np.where(mask, np.abs(scaled), -1.0).reshape(-1, scaled.shape[2]).argmax(axis=0)
        worst.append(np.stack(np.unravel_index(largest, scaled.shape[:2]), axis=-1))
    values = np.stack(rows)
    kept = np.isfinite(values).any(axis=1)
    phases_kept = tuple(n for n, k in zip(names, kept, strict=True) if k)
    return Heat(replay.layout.joint_names, phases_kept, values[kept], np.stack(worst)[kept])


def curves(comparison: Comparison) -> list[Curve]:
    """Error against load, speed, command size, slope, time, …; a condition that never varies is left out."""
    replay, scaled = comparison.replay, _scaled(comparison)
    found = conditions(replay.layout, replay.measurements, replay.time, comparison.predicted)
    drawn = [_curve(c.name, c.unit, c.values, scaled) for c in found]
    return [curve for curve in drawn if curve is not None]


def steady(comparison: Comparison) -> list[str]:
    """Conditions that hardly vary in these rollouts, so that no error can be drawn against them."""
    replay = comparison.replay
    found = conditions(replay.layout, replay.measurements, replay.time, comparison.predicted)
    drawn = {curve.condition for curve in curves(comparison)}
    return [c.name for c in found if c.name not in drawn]


def _curve(condition: str, unit: str, values: np.ndarray, scaled: np.ndarray) -> Curve | None:
    valid = np.isfinite(scaled) & np.isfinite(values)
    x, y = values[valid], scaled[valid]
    edges = _edges(x)
    if len(edges) < 3:
        return None
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    enough = count >= FEWEST
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.bincount(which, x, len(edges) - 1) / count
        error = np.sqrt(np.bincount(which, y**2, len(edges) - 1) / count)
    return Curve(condition, unit, middle[enough], error[enough]) if enough.sum() > 1 else None


def _edges(x: np.ndarray) -> np.ndarray:
    """Of the bins of samples (n,): one for each value where there are few, else equally many samples in each."""
    levels = np.unique(x)
    if len(levels) <= BINS:
        return np.append(levels, np.inf) if len(levels) else levels
    return np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))


def _scaled(comparison: Comparison) -> np.ndarray:
    """(R, T, J) joint errors over their noise floors."""
    joints = comparison.replay.layout.where(JOINT)
    residual = comparison.replay.measured - comparison.predicted
    return residual[..., joints] / comparison.floor.values[joints]
