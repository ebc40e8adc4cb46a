"""What a statistic sees (`RolloutArrays`) and what it is (`Statistic`).

Measured and simulated rollouts come as the same arrays on the same grid, so that one function serves both and a
difference between its results can only come from the physics.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from tcbi_sim.measurement import Measurement, Scenario, roll_pitch_yaw
from tcbi_sim.sensing import multiply

OF_PARTICLES = (
    "joint_position", "command_target", "attitude", "angular_velocity", "contact", "position", "distance",
)  # fields of (N, ...)  # fmt: skip


@dataclass(frozen=True)
class RolloutArrays:
    """N x S rollouts on one grid of T times; what was not measured is None. Measured data has N = 1."""

    time: np.ndarray  # (T,) s since BEGIN
    joint_position: np.ndarray  # (N, S, T, J) rad
    command_time: np.ndarray  # (S, K) s, NaN after a rollout's last command
    command_target: np.ndarray  # (N, S, K, J) rad
    command_ramp: float  # s
    scenarios: tuple[Scenario, ...]  # S
    joint_names: tuple[str, ...]
    foot_names: tuple[str, ...]
    attitude: np.ndarray | None = None  # (N, S, T, 4) w x y z
    angular_velocity: np.ndarray | None = None  # (N, S, T, 3) rad/s
    contact: np.ndarray | None = None  # (N, S, T, F) bool
    position: np.ndarray | None = None  # (N, S, T, 3) m
    distance: np.ndarray | None = None  # (N, S) m from first to last time, along the heading at the start; NaN: unknown

    @property
    def count(self) -> tuple[int, int]:
        """(N, S)."""
        return self.joint_position.shape[:2]

    def only(self, particles: slice) -> "RolloutArrays":
        """The rollouts of some of N particles."""
        present: dict[str, Any] = {name: v for name in OF_PARTICLES if (v := getattr(self, name)) is not None}
        return replace(self, **{name: values[particles] for name, values in present.items()})

    @cached_property
    def roll_pitch(self) -> np.ndarray:
        """(N, S, T, 2) rad."""
        assert self.attitude is not None
        return roll_pitch_yaw(self.attitude)[..., :2]

    @cached_property
    def latest_command(self) -> np.ndarray:
        """(S, T) index of the command in force at each time, -1 before the first."""
        return np.stack(
            [np.searchsorted(row[np.isfinite(row)], self.time + 1e-9, "right") - 1 for row in self.command_time]
        )

    @cached_property
    def reference(self) -> np.ndarray:
        """(N, S, T, J) rad: the commanded ramp, NaN before the first command."""
        index = self.latest_command
        given = np.maximum(index, 0)
        _, s, t, _ = self.joint_position.shape
        commands = self.command_target
        commands = commands[:1] if commands.strides[0] == 0 else commands  # all were given the same
        rollout = np.arange(s)[:, None]
        start, target = commands[:, rollout, np.maximum(given - 1, 0)], commands[:, rollout, given]
        elapsed = self.time - np.take_along_axis(self.command_time, given, axis=1)
        share = np.ones((s, t)) if self.command_ramp <= 0 else np.clip(elapsed / self.command_ramp, 0, 1)
        share = np.where(index < 0, np.nan, share)
        ramp = np.broadcast_to(start + (target - start) * share[None, :, :, None], self.joint_position.shape).copy()
        for r, first in enumerate(given == 0):  # the first ramp begins where the joints were
            begin = self.joint_position[:, r, :1]
            ramp[:, r, first] = begin + (commands[:, r, :1] - begin) * share[r, first, None]
        return ramp

    def at(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """(N, S, T, J) values at (S, K) times -> (N, S, K, J), linear between samples, NaN outside the grid."""
        inside = np.isfinite(time) & (time >= self.time[0] - 1e-9) & (time <= self.time[-1] + 1e-9)
        t = np.where(inside, time, self.time[0])
        left = np.clip(np.searchsorted(self.time, t, "right") - 1, 0, len(self.time) - 2)
        share = (t - self.time[left]) / (self.time[left + 1] - self.time[left])
        share = np.where(inside, share, np.nan)[None, :, :, None]
        rollout = np.arange(time.shape[0])[:, None]
        return values[:, rollout, left] * (1 - share) + values[:, rollout, left + 1] * share


def averaged(arrays: RolloutArrays, signals: Sequence[str], duration: float, turning: float) -> RolloutArrays:
    """The same with some signals as the mean over neighbouring samples, as many on either side.

    Attitudes are turned along by the body rates before they are averaged, so that a mean may be long. At the ends, and
    beside samples that are missing, it is over as many as there are; a missing one stays missing.

    Args:
      arrays: measured or simulated.
      signals: fields of (N, S, T, ...); those that were not measured stay so.
      duration: s that the samples of a mean stand for; one that is not much more than a sample's leaves all as it is.
      turning: the same of attitudes where body rates were measured.
    """
    step = float(arrays.time[1] - arrays.time[0])
    found: dict[str, Any] = {}
    for name in signals:
        values = getattr(arrays, name)
        if values is None:
            continue
        if name != "attitude":
            found[name] = _moving_mean(values, _reach(duration, step))
        elif arrays.angular_velocity is None:
            found[name] = _mean_attitude(values, _reach(duration, step))
        else:
            turned = _turned(arrays.angular_velocity, step)
            start = multiply(values, turned * [1.0, -1.0, -1.0, -1.0])  # what each says of the first: noise, and drift
            found[name] = multiply(_mean_attitude(start, _reach(turning, step)), turned)
    return replace(arrays, **found)


def _reach(duration: float, step: float) -> int:
    """Samples on either side of one that a mean over a duration takes."""
    return max(0, round((duration / step - 1) / 2))


def _mean_attitude(values: np.ndarray, reach: int) -> np.ndarray:
    mean = _moving_mean(_one_sign(values), reach)
    return mean / np.linalg.norm(mean, axis=-1, keepdims=True)


def _turned(rates: np.ndarray, step: float) -> np.ndarray:
    """(N, S, T, 4) attitude relative to the first by (N, S, T, 3) body rates, which rest where they are missing."""
    rates = np.nan_to_num(rates)
    half = (rates[:, :, 1:] + rates[:, :, :-1]) * (step / 4)
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    turns = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=-1)
    turned = np.empty((*rates.shape[:-1], 4))
    turned[:, :, 0] = [1.0, 0.0, 0.0, 0.0]
    for t in range(turns.shape[2]):
        turned[:, :, t + 1] = multiply(turned[:, :, t], turns[:, :, t])
    return turned


def _one_sign(attitude: np.ndarray) -> np.ndarray:
    """(N, S, T, 4) quaternions, of which each and its negative mean the same, without jumps from one to the other."""
    along = np.sum(attitude[:, :, 1:] * attitude[:, :, :-1], axis=-1)
    sign = np.cumprod(np.where(along < 0, -1.0, 1.0), axis=-1)
    return np.concatenate([attitude[:, :, :1], attitude[:, :, 1:] * sign[..., None]], axis=2)


def _moving_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """(N, S, T, D) over so many samples on either side."""
    known = np.isfinite(values)
    total, count = np.zeros_like(values), np.zeros(values.shape, int)
    length = values.shape[2]
    for shift in range(-reach, reach + 1):
        here, there = slice(max(0, -shift), length - max(0, shift)), slice(max(0, shift), length + min(0, shift))
        total[:, :, here] += np.where(known, values, 0.0)[:, :, there]
        count[:, :, here] += known[:, :, there]
    return np.where(known, total / np.maximum(count, 1), np.nan)


def nothing_more(arrays: RolloutArrays) -> str:
    """The check of a statistic that needs only the signals it names."""
    return ""


@dataclass(frozen=True)
class Statistic:
    """Rollouts -> samples of something that the task's performance depends on.

    `compute` returns `(N, S, C, K)`: K samples in order of time for each of C channels; NaN where there is none.
    """

    name: str
    unit: str
    description: str
    needs: tuple[str, ...]  # fields of RolloutArrays that may be None
    channels: Callable[[RolloutArrays], tuple[str, ...]]
    compute: Callable[[RolloutArrays], np.ndarray]
    lacks: Callable[[RolloutArrays], str] = nothing_more  # "" or what else is missing
    in_time: bool = False  # compared in time where commands are replayed, not as histograms: K samples on the time grid

    def missing(self, arrays: RolloutArrays) -> str:
        """ "" if these rollouts have all that the statistic needs, else what they lack."""
        absent = [name.replace("_", " ") for name in self.needs if getattr(arrays, name) is None]
        return f"no {' and no '.join(absent)}" if absent else self.lacks(arrays)


def from_measurements(measurements: Sequence[Measurement], time: np.ndarray) -> RolloutArrays:
    """S measurements of one rig on the grid `time`, as arrays with N = 1."""
    resampled = [m.resampled(time) for m in measurements]
    first = measurements[0]

    def stacked(field: str) -> np.ndarray | None:
        values = [getattr(m, field) for m in resampled]
        return None if any(v is None for v in values) else np.stack(values)[None]

    command_time, command_target = padded_commands([(m.commands.time, m.commands.target) for m in measurements])
    distance = np.array([[m.distance for m in measurements]])
    joint_position = stacked("joint_position")
    assert joint_position is not None
    return RolloutArrays(
        time=time,
        joint_position=joint_position,
        command_time=command_time,
        command_target=command_target[None],
        command_ramp=first.commands.ramp,
        scenarios=tuple(m.scenario for m in measurements),
        joint_names=first.joint_names,
        foot_names=next((m.foot_names for m in measurements if m.contact is not None), first.foot_names),
        attitude=stacked("attitude"),
        angular_velocity=stacked("angular_velocity"),
        contact=stacked("contact"),
        position=stacked("position"),
        distance=distance if np.isfinite(distance).any() else None,
    )


def padded_commands(commands: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """S pairs of (K,) times and (K, J) targets -> (S, K), (S, K, J); NaN times and repeated targets fill up."""
    longest = max(len(time) for time, _ in commands)
    times = np.full((len(commands), longest), np.nan)
    targets = np.empty((len(commands), longest, commands[0][1].shape[1]))
    for s, (time, target) in enumerate(commands):
        times[s, : len(time)] = time
        targets[s, : len(time)] = target
        targets[s, len(time) :] = target[-1] if len(time) else 0.0
    return times, targets
