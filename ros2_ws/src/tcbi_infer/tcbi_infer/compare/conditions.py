"""Under what a joint errs: phases of its motion, and conditions that may make an error grow.

Phases are masks: stance and swing (where the rig has feet), just after a reversal of direction, standing still, moving.
Conditions are numbers: load, speed, command size, slope, time since start, temperature and voltage where they were
read, and whatever the recording says of itself as a constant that differs between rollouts (a gain, a supply voltage).

The commands of a rig that is driven by torque tell no motion: its phases are those of the predicted one, and its load
is the torque.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.kinds import UNDER_LOAD
from tcbi_infer.compare.replicates import by_torque
from tcbi_infer.compare.signals import DEGREE, JOINT, Layout, reference
from tcbi_infer.readings import QUANTITIES, Quantity, on_joints
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig

STANCE, SWING, REVERSAL = "in stance", "in swing", "just after reversing direction"
STILL, MOVING = "while standing still", "while moving"
REVERSAL_S = 0.15  # s after a change of direction
SLOW = 0.05  # rad/s below which a joint counts as standing still
LARGE = 2.0 / 3.0  # quantile from which a condition counts as high
NEVER = 1e-9  # range of a condition that does not vary


@dataclasses.dataclass(frozen=True)
class Condition:
    """One number for each sample and joint.

    Attributes:
      values: (R, T, J).
      high: the words for its upper third in a sentence.
      reading: which quantity was read, if one was: either end of it may be what errs, and the words tell the value.
    """

    name: str
    unit: str
    values: np.ndarray
    high: str = ""
    reading: Quantity | None = None

    @property
    def varies(self) -> bool:
        """Whether there is anything to set the error against."""
        known = self.values[np.isfinite(self.values)]
        least = self.reading.least - NEVER if self.reading else NEVER
        return bool(len(known)) and float(np.ptp(known)) > least

    def upper(self) -> np.ndarray:
        """(R, T, J) bool: the upper third, by value."""
        known = self.values[np.isfinite(self.values)]
        edge = np.quantile(known, LARGE)
        edge = edge if edge > known.min() else known.min() + 0.5 * np.ptp(known)
        return self.values >= edge

    def parts(self) -> dict[str, np.ndarray]:
        """(R, T, J) bool by the words for them: the upper third; of what was read the lower third as well."""
        if self.reading is None:
            return {self.high: self.upper()}
        known, digits = self.values[np.isfinite(self.values)], self.reading.digits
        low, high = (float(np.quantile(known, q)) for q in (1 - LARGE, LARGE))
        high = min(high, float(known.max())) if high > known.min() else float(known.min() + 0.5 * np.ptp(known))
        low = low if low < known.max() else float(known.min() + 0.5 * np.ptp(known))
        low, high = math.floor(low * 10**digits) / 10**digits, math.ceil(high * 10**digits) / 10**digits
        return {
            f"at {high:.{digits}f} {self.unit} and above": self.values >= high - NEVER,
            f"at {low:.{digits}f} {self.unit} and below": self.values <= low + NEVER,
        }


def phases(
    rig: Rig, measurement: Measurement, time: np.ndarray, predicted: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Boolean masks (T, J) over samples and joints, by phase of the commanded motion; by torque, of the predicted one.

    Args:
      rig: the robot.
      measurement: the rollout, sampled at `time`.
      time: (T,) s of the common grid.
      predicted: (T, J) rad, for a rig driven by torque; without it the measured motion counts.
    """
    if rig.kind == "position":
        motion = reference(measurement, time)
    else:
        motion = measurement.joint_position if predicted is None else predicted
    speed = np.gradient(motion, time, axis=0)
    moving = np.abs(speed) > SLOW
    reversal = _reversals(speed, moving, max(1, round(REVERSAL_S / float(time[1] - time[0]))))
    return {
        **_contact_phases(rig, measurement, len(time)),
        REVERSAL: reversal,
        STILL: ~moving & ~reversal,
        MOVING: moving & ~reversal,
    }


def _reversals(speed: np.ndarray, moving: np.ndarray, length: int) -> np.ndarray:
    reversal = np.zeros_like(moving)
    for j in range(speed.shape[1]):
        last = 0.0
        for t in np.nonzero(moving[:, j])[0]:
            sign = np.sign(speed[t, j])
            if last and sign != last:
                reversal[t : t + length, j] = True
            last = sign
    return reversal


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
    return {STANCE: stance, SWING: swing} if swing.any() else {}


def conditions(
    layout: Layout, measurements: Sequence[Measurement], time: np.ndarray, predicted: np.ndarray
) -> list[Condition]:
    """What may make an error grow; what never varies is left out.

    Load is how far the model's servo gives way, commanded less predicted position: what a position servo turns into
    torque. It is taken from the prediction, since the measured position stands in the error itself. A rig driven by
    torque has its torque as load, and nothing else of its commands.

    Args:
      layout: the channels.
      measurements: (R) rollouts, on the common grid.
      time: (T,) s.
      predicted: (R, T, C).
    """
    angles = predicted[..., layout.where(JOINT)]
    shape = angles.shape
    slope = [np.hypot(m.scenario.slope_roll, m.scenario.slope_pitch) * DEGREE for m in measurements]
    found = [
        *_commanded(measurements, time, angles),
        Condition("slope", "deg", _wide(slope, shape), "on the steeper slopes"),
        Condition("time since start", "s", np.broadcast_to(time[None, :, None], shape), "late in the rollouts"),
    ]
    return [c for c in (*found, *read(measurements, time), *_recorded(measurements, shape)) if c.varies]


def torques(measurement: Measurement, time: np.ndarray) -> np.ndarray:
    """(T, J) N m: what the commands of a rig driven by torque asked for, nothing before the first."""
    still = dataclasses.replace(measurement, joint_position=np.zeros_like(measurement.joint_position))
    return reference(still, time)


def _commanded(measurements: Sequence[Measurement], time: np.ndarray, angles: np.ndarray) -> list[Condition]:
    """Load, speed and size of the commands from the predicted (R, T, J) deg."""
    if by_torque(measurements[0]):
        torque = np.abs(np.stack([torques(m, time) for m in measurements]))
        return [Condition("load: the torque commanded", "N m", torque, UNDER_LOAD)]
    asked = np.stack([reference(m, time) for m in measurements])
    return [
        Condition("load: the model's servo gives way", "deg", np.abs(asked * DEGREE - angles), UNDER_LOAD),
        Condition("commanded speed", "deg/s", np.abs(np.gradient(asked, time, axis=1)) * DEGREE, "at high speed"),
        Condition("size of the command", "deg", _command_sizes(measurements, time), "on large commands"),
    ]


def _wide(each: Sequence[float], shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(np.asarray(each, float)[:, None, None], shape)


def _command_sizes(measurements: Sequence[Measurement], time: np.ndarray) -> np.ndarray:
    """(R, T, J) deg, how far the command in force asks each joint to go."""
    sizes = []
    for m in measurements:
        before = np.concatenate([m.joint_position[:1], m.commands.target[:-1]])
        step = np.abs(m.commands.target - before) * DEGREE
        row = np.searchsorted(m.commands.time, time + 1e-9, side="right") - 1
        sizes.append(np.where(row[:, None] < 0, 0.0, step[np.maximum(row, 0)]))
    return np.stack(sizes)


def read(measurements: Sequence[Measurement], time: np.ndarray) -> list[Condition]:
    """What the recordings read beside the samples; NaN where they did not."""
    return [
        Condition(q.name, q.unit, np.stack([on_joints(m, q, time) for m in measurements]), reading=q)
        for q in QUANTITIES
        if any(m.readings for m in measurements)
    ]


def _recorded(measurements: Sequence[Measurement], shape: tuple[int, ...]) -> list[Condition]:
    """Constants that every rollout states and that differ, such as a bench's supply voltage or its servo's gain."""
    tables = [dict(m.scenario.constants) for m in measurements]
    names = [name for name in tables[0] if all(name in table for table in tables)]
    return [Condition(name, "", _wide([t[name] for t in tables], shape), f"at high {name}") for name in names]
