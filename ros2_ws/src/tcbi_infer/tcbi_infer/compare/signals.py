"""One layout for what is compared: every signal as a channel of a (..., T, C) array, in units for people.

Joint angles, roll and pitch are compared sample by sample; body rates and accelerations as means over 60 ms and
contacts as means over 100 ms, because single samples of these say more about noise and contact chatter than about
physics. What was not measured is NaN and weighs nothing.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from tcbi_sim.measurement import Measurement, roll_pitch_yaw

DEGREE = 180.0 / math.pi
RATE_HZ = 50.0  # of the common grid


@dataclasses.dataclass(frozen=True)
class Group:
    """Signals of one kind, which share a unit, an averaging window and a least error worth speaking of."""

    name: str
    unit: str
    window: float  # s, averaged over; 0 for single samples
    resolution: float  # smallest noise floor credible for this kind, in `unit`
    fitted: bool = True  # whether fits look at it


JOINT = Group("joint_position", "deg", 0.0, 0.03)
ATTITUDE = Group("attitude", "deg", 0.0, 0.03)
RATE = Group("angular_velocity", "deg/s", 0.06, 0.5)
ACCELERATION = Group("linear_acceleration", "m/s^2", 0.06, 0.05, fitted=False)
CONTACT = Group("contact", "share", 0.1, 0.3)
GROUPS = (JOINT, ATTITUDE, RATE, ACCELERATION, CONTACT)


@dataclasses.dataclass(frozen=True)
class Channel:
    """One compared signal."""

    name: str
    group: Group
    index: int  # within its group


class Samples(Protocol):
    """What a measurement and a batch of simulated rollouts have in common; arrays are (..., T, width) or None."""

    @property
    def joint_position(self) -> np.ndarray: ...
    @property
    def attitude(self) -> np.ndarray | None: ...
    @property
    def angular_velocity(self) -> np.ndarray | None: ...
    @property
    def linear_acceleration(self) -> np.ndarray | None: ...
    @property
    def contact(self) -> np.ndarray | None: ...


@dataclasses.dataclass(frozen=True)
class Layout:
    """The channels that a set of rollouts has, in a fixed order."""

    joint_names: tuple[str, ...]
    foot_names: tuple[str, ...]
    channels: tuple[Channel, ...]
    rate: float = RATE_HZ

    @staticmethod
    def of(measurements: Sequence[Measurement], rate: float = RATE_HZ) -> "Layout":
        """Every signal that at least one of the rollouts measured."""
        first = measurements[0]
        feet = next((m.foot_names for m in measurements if m.contact is not None), first.foot_names)
        present = {
            "attitude": any(m.attitude is not None for m in measurements),
            "angular_velocity": any(m.angular_velocity is not None for m in measurements),
            "linear_acceleration": any(m.linear_acceleration is not None for m in measurements),
            "contact": any(m.contact is not None for m in measurements),
        }
        names = {
            JOINT: first.joint_names,
            ATTITUDE: ("roll", "pitch"),
            RATE: ("rate_x", "rate_y", "rate_z"),
            ACCELERATION: ("acceleration_x", "acceleration_y", "acceleration_z"),
            CONTACT: tuple(f"contact_{f}" for f in feet),
        }
        channels = tuple(
            Channel(name, group, i)
            for group in GROUPS
            if group is JOINT or present[group.name]
            for i, name in enumerate(names[group])
        )
        return Layout(first.joint_names, feet, channels, rate)

    def where(self, *groups: Group) -> np.ndarray:
        """(n,) indices of the channels of these groups."""
        return np.array([i for i, c in enumerate(self.channels) if c.group in groups], dtype=int)

    @property
    def averaged(self) -> np.ndarray:
        """(C,) bool: whether a channel is compared as an average over some samples."""
        return np.array([c.group.window > 0 for c in self.channels], dtype=bool)

    def index(self, name: str) -> int:
        """Index of a channel by its name."""
        return next(i for i, c in enumerate(self.channels) if c.name == name)

    def extract(self, samples: Samples) -> np.ndarray:
        """(..., T, C) channel values in the groups' units; NaN where the samples lack a signal."""
        shape = samples.joint_position.shape[:-1]
        parts: dict[str, np.ndarray | None] = {
            "joint_position": samples.joint_position * DEGREE,
            "attitude": None if samples.attitude is None else roll_pitch_yaw(samples.attitude)[..., :2] * DEGREE,
            "angular_velocity": None if samples.angular_velocity is None else samples.angular_velocity * DEGREE,
            "linear_acceleration": samples.linear_acceleration,
            "contact": None if samples.contact is None else np.asarray(samples.contact, float),
        }
        columns = []
        for group in GROUPS:
            count = len(self.where(group))
            if not count:
                continue
            values = parts[group.name]
            if values is None or values.shape[-1] < count:
                values = np.full((*shape, count), np.nan)
            columns.append(window_mean(values[..., :count], self.samples_in(group)))
        return np.concatenate(columns, axis=-1)

    def samples_in(self, group: Group) -> int:
        """Samples of the common grid that one value of `group` averages over."""
        return max(1, round(group.window * self.rate))

    def kept(self, length: int) -> np.ndarray:
        """(T, C) bool: one value per window, so that averages do not count several times."""
        keep = np.zeros((length, len(self.channels)), bool)
        for i, channel in enumerate(self.channels):
            n = self.samples_in(channel.group)
            keep[n // 2 :: n, i] = True
        return keep

    def floor(self) -> np.ndarray:
        """(C,) the smallest noise floor credible for each channel."""
        return np.array([c.group.resolution for c in self.channels])


def window_mean(values: np.ndarray, count: int) -> np.ndarray:
    """Centred running mean over `count` samples along the second-last axis; shorter at the ends."""
    if count <= 1:
        return values
    length = values.shape[-2]
    total = np.concatenate([np.zeros_like(values[..., :1, :]), np.cumsum(values, axis=-2)], axis=-2)
    first = np.clip(np.arange(length) - count // 2, 0, length)
    last = np.clip(np.arange(length) - count // 2 + count, 0, length)
    return (total[..., last, :] - total[..., first, :]) / (last - first)[:, None]


def reference(measurement: Measurement, time: np.ndarray) -> np.ndarray:
    """(T, J) rad: what the commands asked of each joint at `time`, their ramps included."""
    commands = measurement.commands
    start = measurement.joint_position[0]
    result = np.empty((len(time), commands.target.shape[1]))
    for j in range(result.shape[1]):
        times, values = _corners(commands.time, commands.target[:, j], commands.ramp, float(start[j]))
        result[:, j] = np.interp(time, times, values)
    return result


def _corners(at: np.ndarray, target: np.ndarray, ramp: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a piecewise linear command; a ramp cut short by the next command starts from where it was."""
    times, values, now = [float(at[0]) if len(at) else 0.0], [start], start
    for k, begin in enumerate(at):
        end = min(begin + max(ramp, 1e-6), at[k + 1] if k + 1 < len(at) else np.inf)
        share = (end - begin) / max(ramp, 1e-6)
        times += [float(begin), float(end)]
        values += [now, now + (float(target[k]) - now) * share]
        now = values[-1]
    return np.maximum.accumulate(np.array(times)), np.array(values)
