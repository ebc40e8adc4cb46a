"""Where the error lives: which joints, in which phase of the motion, under which condition; ranked sentences.

Everything is computed from the residuals and the commands, for any rig: joints form the groups that the rig names, and
stance or swing exists where the rig has legs with feet.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from tcbi_infer.compare.signals import ATTITUDE, JOINT, RATE, Layout, reference
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig

REVERSAL_S = 0.15  # s around a change of direction
FEWEST = 25  # samples that a cell needs


@dataclasses.dataclass(frozen=True)
class Finding:
    """One place where the error lives.

    Attributes:
      statement: a sentence for people, computed from the data.
      score: share of the whole excess squared error that lies there, beyond the cell's share of the samples, 0..1.
      channels: names of the channels concerned.
      phase: the phase or condition, "" for all samples.
      rms: error there, in the channels' unit; `elsewhere` the same outside the cell.
    """

    statement: str
    score: float
    channels: tuple[str, ...]
    phase: str
    rms: float
    elsewhere: float
    over_floor: float


def joint_cells(rig: Rig) -> dict[str, tuple[int, ...]]:
    """Sets of joints to look at: the rig's named groups, and each joint by itself."""
    cells = {name: tuple(rig.index(j) for j in joints) for name, joints in rig.groups.items()}
    cells |= {name: (j,) for j, name in enumerate(rig.joint_names)}
    return {name: joints for name, joints in cells.items() if len(joints) < len(rig.joint_names)}


def phases(rig: Rig, measurement: Measurement, time: np.ndarray, speed_limit: float = 0.05) -> dict[str, np.ndarray]:
    """Boolean masks over samples and joints, by phase of the commanded motion.

    Args:
      rig: the robot.
      measurement: the rollout, sampled at `time`.
      time: (T,) s of the common grid.
      speed_limit: rad/s below which a joint counts as standing still.

    Returns:
      phase -> (T, J) bool.
    """
    asked = reference(measurement, time)
    speed = np.gradient(asked, time, axis=0)
    moving = np.abs(speed) > speed_limit
    reversal = np.zeros_like(moving)
    near = max(1, round(REVERSAL_S / float(time[1] - time[0])))
    for j in range(asked.shape[1]):
        last = 0.0
        for t in np.nonzero(moving[:, j])[0]:
            sign = np.sign(speed[t, j])
            if last and sign != last:
                reversal[t : t + near, j] = True
            last = sign
    result = {
        "while standing still": ~moving & ~reversal,
        "while moving": moving & ~reversal,
        "just after reversing direction": reversal,
    }
    fast = np.abs(speed) > np.quantile(np.abs(speed)[moving], 0.67) if moving.any() else moving
    result["at high speed"] = fast & moving
    result.update(_contact_phases(rig, measurement, len(time)))
    result["in the last third of the rollout"] = np.broadcast_to((time > time[-1] * 2 / 3)[:, None], moving.shape)
    slope = np.hypot(measurement.scenario.slope_roll, measurement.scenario.slope_pitch)
    result["on slopes above 5 degrees"] = np.full_like(moving, slope > np.radians(5.0))
    return result


def _contact_phases(rig: Rig, measurement: Measurement, length: int) -> dict[str, np.ndarray]:
    """Stance and swing of the joints of each leg that has a foot."""
    if measurement.contact is None or len(measurement.contact) != length:
        return {}
    stance = np.zeros((length, len(measurement.joint_names)), bool)
    swing = np.zeros_like(stance)
    for f, foot in enumerate(measurement.foot_names):
        joints = [rig.index(j) for j in rig.legs.get(foot, ())]
        stance[:, joints] = measurement.contact[:, f, None]
        swing[:, joints] = ~measurement.contact[:, f, None]
    if not swing.any():
        return {}
    return {"while the foot is on the ground": stance, "while the foot is in the air": swing}


def locate(
    rig: Rig,
    layout: Layout,
    measurements: Sequence[Measurement],
    time: np.ndarray,
    residual: np.ndarray,
    predicted: np.ndarray,
    floor: np.ndarray,
    most: int = 8,
) -> list[Finding]:
    """Ranked places where the error lives.

    Args:
      rig: the robot.
      layout: the channels.
      measurements: (R) rollouts, on the common grid.
      time: (T,) s.
      residual: (R, T, C) measured less predicted, NaN where missing.
      predicted: (R, T, C).
      floor: (C,) noise floor.
      most: sentences at most.
    """
    findings = [f for f in _joint_cells(rig, layout, measurements, time, residual, predicted, floor) if f.score > 0.02]
    findings += _body_findings(layout, residual, floor)
    findings.sort(key=lambda f: -f.score)
    return _without_repeats(findings)[:most]


def _joint_cells(
    rig: Rig,
    layout: Layout,
    measurements: Sequence[Measurement],
    time: np.ndarray,
    residual: np.ndarray,
    predicted: np.ndarray,
    floor: np.ndarray,
) -> Iterator[Finding]:
    joints = layout.where(JOINT)
    errors = residual[..., joints]
    valid = np.isfinite(errors)
    scaled = np.where(valid, (np.nan_to_num(errors) / floor[joints]) ** 2, 0.0)
    excess = np.maximum(scaled - 1.0, 0.0) * valid
    total = excess.sum()
    if total <= 0:
        return
    masks = _stack_phases(rig, measurements, time)
    velocity = np.gradient(predicted[..., joints], time, axis=1)
    groups = joint_cells(rig)
    everything = tuple(range(len(layout.joint_names)))
    for label, members in {"": everything, **groups}.items():
        cell_joints = np.zeros(len(layout.joint_names), bool)
        cell_joints[list(members)] = True
        for phase, mask in {"": np.ones_like(valid), **masks}.items():
            cell = mask & cell_joints & valid
            outside = valid & ~cell
            if cell.sum() < FEWEST or outside.sum() < FEWEST:
                continue
            score = float(excess[cell].sum() / total - cell.sum() / valid.sum())
            here = float(np.sqrt(np.mean(errors[cell] ** 2)))
            there = float(np.sqrt(np.mean(errors[outside] ** 2)))
            over = float(np.sqrt(np.mean(scaled[cell])))
            if here < 1.15 * there or over < 1.5:
                continue
            names = tuple(layout.joint_names[j] for j in members)
            shape = describe_shape(errors[cell], velocity[cell], plural=len(names) > 1)
            who = _who(label, names)
            text = f"{who} {shape} {phase}".strip() + (
                f": {here:.2f} deg, {over:.1f} times the noise floor, against {there:.2f} deg elsewhere."
            )
            yield Finding(text, score, names, phase, here, there, over)


def _stack_phases(rig: Rig, measurements: Sequence[Measurement], time: np.ndarray) -> dict[str, np.ndarray]:
    each = [phases(rig, m, time) for m in measurements]
    names = list(dict.fromkeys(name for masks in each for name in masks))
    shape = (len(time), len(measurements[0].joint_names))
    return {name: np.stack([masks.get(name, np.zeros(shape, bool)) for masks in each]) for name in names}


def describe_shape(error: np.ndarray, velocity: np.ndarray, plural: bool = False) -> str:
    """What the error looks like: a lag, an offset, or neither.

    Args:
      error: (n,) deg, measured less predicted.
      velocity: (n,) deg/s, of the prediction.
      plural: of the verb.
    """
    design = np.stack([np.ones_like(velocity), -velocity], axis=-1)
    coefficients = np.linalg.lstsq(design, error, rcond=None)[0]
    total = float(np.mean(error**2))
    offset, lag = float(coefficients[0]), float(coefficients[1])
    by_offset, by_lag = offset**2 / total, lag**2 * float(np.mean(velocity**2)) / total
    end = "" if plural else "s"
    if by_lag > 0.4 and by_lag > by_offset:
        return f"{'lag' if lag > 0 else 'lead'}{end} the prediction by {1000 * abs(lag):.0f} ms"
    if by_offset > 0.4:
        return f"sit{end} {abs(offset):.1f} deg {'above' if offset > 0 else 'below'} the prediction"
    return f"depart{end} from the prediction"


def _who(label: str, names: Sequence[str]) -> str:
    """The subject of a sentence; plural unless it is a single joint."""
    if len(names) == 1:
        return f"The joint {names[0]}"
    if not label:
        return "All joints together"
    return f"The joints of the {label}" if label.endswith("leg") else f"The {label}"


def _body_findings(layout: Layout, residual: np.ndarray, floor: np.ndarray) -> list[Finding]:
    """Body signals stand apart from joints: tilt that joints do not explain points at sensors, ground or mass."""
    joints = layout.where(JOINT)
    over_joint = _over(residual, floor, joints)
    findings = []
    for group, noun in ((ATTITUDE, "body attitude"), (RATE, "body rates")):
        index = layout.where(group)
        if not len(index) or not np.isfinite(residual[..., index]).any():
            continue
        over = _over(residual, floor, index)
        if over < 1.5 or over < 1.15 * over_joint:
            continue
        rms = float(np.sqrt(np.nanmean(residual[..., index] ** 2)))
        mean = np.nanmean(residual[..., index], axis=(0, 1))
        constant = float(np.sum(mean**2) / np.sum(np.nanmean(residual[..., index] ** 2, axis=(0, 1))))
        kind = ", mostly a constant offset" if constant > 0.6 else ""
        text = (
            f"The {noun} departs from the prediction by {rms:.2f} {group.unit}, {over:.1f} times the noise floor"
            f"{kind}, while the joints stand at {over_joint:.1f} times theirs."
        )
        score = float(min(1.0, 1.0 - over_joint**2 / over**2))
        names = tuple(layout.channels[i].name for i in index)
        findings.append(Finding(text, score, names, "", rms, float("nan"), over))
    return findings


def _over(residual: np.ndarray, floor: np.ndarray, index: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean((residual[..., index] / floor[index]) ** 2)))


def _without_repeats(findings: list[Finding]) -> list[Finding]:
    """Drops sentences that only repeat a better one about the same joints or the same phase."""
    kept: list[Finding] = []
    for finding in findings:
        similar = [
            k
            for k in kept
            if (k.channels == finding.channels and (k.phase == finding.phase or not k.phase or not finding.phase))
            or (
                k.phase == finding.phase
                and set(finding.channels) < set(k.channels)
                and finding.over_floor < 1.3 * k.over_floor
            )
        ]
        if not similar:
            kept.append(finding)
    return kept


def worst_moments(
    residual: np.ndarray, floor: np.ndarray, joints: np.ndarray, count: int, span: int
) -> list[tuple[int, int, int]]:
    """(rollout, first sample, channel) of the worst windows of `span` samples, apart from each other."""
    scaled = np.nan_to_num(residual[..., joints] / floor[joints]) ** 2
    length = scaled.shape[1]
    span = min(span, length)
    total = np.cumsum(np.concatenate([np.zeros_like(scaled[:, :1]), scaled], axis=1), axis=1)
    windows = total[:, span:] - total[:, :-span] if length > span else total[:, -1:]
    moments: list[tuple[int, int, int]] = []
    windows = windows.copy()
    while len(moments) < count and windows.size and windows.max() > 0:
        r, t, c = np.unravel_index(int(np.argmax(windows)), windows.shape)
        moments.append((int(r), int(t), int(joints[c])))
        windows[r, :, c] = -1
        windows[r, max(0, t - span) : t + span, :] = -1
    return moments
