"""What one rollout asks for (`Scenario`), what it was told (`Commands`), what came of it (`Measurement`).

A measurement from a bag and one from the simulator are the same type: everything downstream treats them alike.
What was not measured is None, never filled in.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from tcbi_sim.errors import SimError


@dataclass(frozen=True)
class Block:
    """A box on the ground, in the frame of the ground plane with the robot starting at its origin."""

    center: tuple[float, float, float]  # m
    size: tuple[float, float, float]  # m, full edges
    yaw: float = 0.0  # rad


@dataclass(frozen=True)
class Scenario:
    """What one rollout asks for, without any physical parameter."""

    task: str
    duration: float  # s
    slope_roll: float = 0.0  # rad, ground plane in the world
    slope_pitch: float = 0.0  # rad
    blocks: tuple[Block, ...] = ()
    initial_joint_position: tuple[float, ...] | None = None  # rad; None for the neutral stance
    initial_joint_velocity: tuple[float, ...] | None = None  # rad/s, of a piece out of a longer motion; None for rest
    initial_yaw: float = 0.0  # rad
    settle: float = 1.0  # s that the simulator holds the initial posture before time 0
    seed: int = 0
    constants: tuple[tuple[str, float], ...] = ()  # known numbers of this rollout, such as a test bench's kp

    def constant(self, name: str, default: float | None = None) -> float:
        """A known number of this rollout.

        Raises:
          SimError: it is absent and there is no default.
        """
        for key, value in self.constants:
            if key == name:
                return value
        if default is None:
            known = ", ".join(k for k, _ in self.constants) or "none"
            raise SimError(f"the rollout lacks the constant {name!r} (it has: {known}); add it to the import mapping")
        return default


@dataclass(frozen=True)
class Commands:
    """Commands on the rollout's clock, of which 0 is the BEGIN event."""

    time: np.ndarray  # (K,) s, strictly increasing
    target: np.ndarray  # (K, J) rad, or N m for a rig driven by torque
    ramp: float = 0.2  # s from the last commanded position to the target; 0 is a step
    torque_on: np.ndarray | None = None  # (K,) bool; None: always on

    def __post_init__(self) -> None:
        if self.time.ndim != 1 or self.target.shape[:1] != self.time.shape:
            raise SimError(
                f"commands need (K,) times and (K, J) targets, got {self.time.shape} and {self.target.shape}"
            )
        if np.any(np.diff(self.time) <= 0):
            raise SimError("command times must increase strictly; sort the recording or drop the repeated ones")


@dataclass(frozen=True)
class Measurement:
    """One rollout as aligned arrays: T samples, J joints, F feet."""

    rollout_id: str
    rig: str
    scenario: Scenario
    policy_id: str
    source: str  # driver, sim, or free text
    commands: Commands
    joint_names: tuple[str, ...]
    foot_names: tuple[str, ...]
    time: np.ndarray  # (T,) s since BEGIN
    joint_position: np.ndarray  # (T, J) rad
    attitude: np.ndarray | None = None  # (T, 4) w x y z, base in world
    angular_velocity: np.ndarray | None = None  # (T, 3) rad/s, imu_link
    linear_acceleration: np.ndarray | None = None  # (T, 3) m/s^2 with gravity, imu_link
    contact: np.ndarray | None = None  # (T, F) bool
    position: np.ndarray | None = None  # (T, 3) m, from a tracker
    distance: float = math.nan  # m, travelled forward
    notes: tuple[str, ...] = ()  # what a reader found missing or repaired
    gaps: tuple[tuple[str, float, float], ...] = ()  # field, from, to (s): only interpolated there, not measured
    readings: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    # ^ slow ones beside the samples, as `voltage_V` or `temperature_C/<joint>` -> (N,) s since BEGIN, (N,) values

    def resampled(self, time: np.ndarray, curved: bool = False) -> "Measurement":
        """The same rollout at other times: between samples interpolated, contacts the last one seen.

        Args:
          time: (T',) s; outside the recording the first or last sample is repeated.
          curved: between samples by Akima's curve, else by straight lines.
        """

        def between(values: np.ndarray | None) -> np.ndarray | None:
            if values is None:
                return None
            return np.stack([_interpolated(time, self.time, column, curved) for column in values.T], axis=-1)

        attitude = between(None if self.attitude is None else continuous(self.attitude))
        if attitude is not None:
            attitude = attitude / np.linalg.norm(attitude, axis=-1, keepdims=True)
        last = np.clip(np.searchsorted(self.time, time + 1e-9, side="right") - 1, 0, len(self.time) - 1)
        joint_position = between(self.joint_position)
        assert joint_position is not None
        return dataclasses.replace(
            self,
            time=np.asarray(time, float),
            joint_position=joint_position,
            attitude=attitude,
            angular_velocity=between(self.angular_velocity),
            linear_acceleration=between(self.linear_acceleration),
            contact=None if self.contact is None else self.contact[last],
            position=between(self.position),
        )


def _interpolated(time: np.ndarray, own: np.ndarray, values: np.ndarray, curved: bool) -> np.ndarray:
    """(T',) values at other times; straight lines where a curve cannot be laid through what there is."""
    result = np.interp(time, own, values)
    if curved and len(own) > 1 and np.all(np.diff(own) > 0) and np.isfinite(values).all():
        inside = (time >= own[0]) & (time <= own[-1])
        result[inside] = Akima1DInterpolator(own, values, method="makima")(time[inside])
    return result


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """(T, 4) quaternions with signs chosen so that neighbours are close."""
    dots = np.sum(quaternion[1:] * quaternion[:-1], axis=-1)
    signs = np.concatenate([[1.0], np.cumprod(np.where(dots < 0, -1.0, 1.0))])
    return quaternion * signs[:, None]


def roll_pitch_yaw(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) w x y z -> (..., 3) rad, of Rz(yaw) Ry(pitch) Rx(roll), yaw in (-pi, pi]."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion_from_rpy(roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """rad -> (..., 4) w x y z, of Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    cy, sy = np.cos(yaw / 2), np.sin(yaw / 2)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def progress(position: np.ndarray, heading: np.ndarray | float = 0.0) -> np.ndarray:
    """Displacement (..., T) in m along the heading at the start (rad) of positions (..., T, 3) in m."""
    moved = position[..., :2] - position[..., :1, :2]
    heading = np.asarray(heading, float)[..., None]
    return moved[..., 0] * np.cos(heading) + moved[..., 1] * np.sin(heading)


def observation(joint_position: np.ndarray, attitude: np.ndarray, yaw0: np.ndarray | float = 0.0) -> np.ndarray:
    """What a policy sees: (..., J + 3), the joint angles, then roll, pitch and the yaw since the start (rad)."""
    rpy = roll_pitch_yaw(attitude)
    rpy[..., 2] = (rpy[..., 2] - yaw0 + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([joint_position, rpy], axis=-1)
