"""From true signals to readings: mounting tilt, zero offsets, bias and latency of the sensors."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tcbi_sim.fields import SensingFields
from tcbi_sim.measurement import Measurement, quaternion_from_rpy
from tcbi_sim.rig import Noise

if TYPE_CHECKING:
    from tcbi_sim.engine import SimulatedRollouts


@dataclass
class Samples:
    """Sensor samples of B simulations at n times."""

    time: np.ndarray  # (n,) s, simulator time
    joint_position: np.ndarray  # (B, n, J) rad
    attitude: np.ndarray | None  # (B, n, 4) w x y z
    angular_velocity: np.ndarray | None  # (B, n, 3) rad/s
    linear_acceleration: np.ndarray | None  # (B, n, 3) m/s^2
    contact: np.ndarray | None  # (B, n, F) bool
    position: np.ndarray | None  # (B, n, 3) m

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The arrays with a time axis at position 1."""
        return tuple(f.name for f in dataclasses.fields(cls) if f.name != "time")

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> "Samples":
        """The same with `change` applied to every array that is there, `time` left alone."""
        values = {n: getattr(self, n) for n in self.names()}
        changed: dict[str, Any] = {n: None if v is None else change(v) for n, v in values.items()}
        return dataclasses.replace(self, **changed)

    @staticmethod
    def concatenate(parts: "list[Samples]") -> "Samples":
        """Consecutive samples joined along time."""
        joined: dict[str, Any] = {"time": np.concatenate([p.time for p in parts])}
        for name in Samples.names():
            first = getattr(parts[0], name)
            joined[name] = None if first is None else np.concatenate([getattr(p, name) for p in parts], axis=1)
        return Samples(**joined)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions (..., 4), w x y z."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate_back(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) seen from the frame that `quaternion` (..., 4) turns to."""
    w, u = quaternion[..., :1], -quaternion[..., 1:]
    crossed = 2 * np.cross(u, vector)
    return vector + w * crossed + np.cross(u, crossed)


def sense(raw: Samples, fields: SensingFields) -> Samples:
    """Readings without latency: offsets, tilt and then bias, about the IMU's own axes, applied to the true signals."""
    sensed = dataclasses.replace(raw, joint_position=raw.joint_position - fields.joint_offset[:, None, :])
    if raw.attitude is not None and fields.imu_tilt.any():
        tilt = quaternion_from_rpy(fields.imu_tilt[:, 0], fields.imu_tilt[:, 1], np.zeros(len(fields.imu_tilt)))[
            :, None, :
        ]
        sensed.attitude = multiply(raw.attitude, tilt)
        tilted = np.broadcast_to(tilt, raw.attitude.shape)
        for name in ("angular_velocity", "linear_acceleration"):
            values = getattr(sensed, name)
            if values is not None:
                setattr(sensed, name, rotate_back(tilted, values))
    if sensed.angular_velocity is not None:
        sensed.angular_velocity = sensed.angular_velocity + fields.gyro_bias[:, None, :]
    return sensed


def delay(samples: Samples, latency: np.ndarray, times: np.ndarray) -> Samples:
    """Readings as they arrive at `times` (n,) when each simulation's sensors lag by `latency` (B,) s.

    Joint angles and attitude between two samples lie on the cubic through these and the two before: a straight line
    would cut corners by as much as a robot differs from itself. It looks at nothing later, so that it does not matter
    up to when a simulation has come.
    """
    wanted = np.maximum(times[None, :] - latency[:, None], samples.time[0])
    after = np.clip(np.searchsorted(samples.time, wanted), 1, max(1, len(samples.time) - 1))
    if len(samples.time) == 1:
        return dataclasses.replace(samples.map(lambda v: np.repeat(v, len(times), axis=1)), time=times)
    before = after - 1
    share = (wanted - samples.time[before]) / (samples.time[after] - samples.time[before])
    share = np.clip(share, 0.0, 1.0)
    rows = np.arange(len(latency))[:, None]

    def pick(values: np.ndarray) -> np.ndarray:
        low, high = values[rows, before], values[rows, after]
        if values.dtype == bool:
            return np.where((share >= 1.0)[..., None], high, low)
        return low + share[..., None] * (high - low)

    x = share[..., None]
    weights = (
        -(x + 1) * x * (x - 1) / 6,
        (x + 2) * x * (x - 1) / 2,
        -(x + 2) * (x + 1) * (x - 1) / 2,
        (x + 2) * (x + 1) * x / 6,
    )

    def curved(values: np.ndarray) -> np.ndarray:
        """Before the first sample everything stood still."""
        nodes = (values[rows, np.maximum(after - back, 0)] for back in (3, 2, 1, 0))
        return sum(weight * node for weight, node in zip(weights, nodes, strict=True))

    delayed = dataclasses.replace(samples.map(pick), time=times, joint_position=curved(samples.joint_position))
    if samples.attitude is not None:
        delayed.attitude = curved(samples.attitude)
        delayed.attitude /= np.linalg.norm(delayed.attitude, axis=-1, keepdims=True)
    return delayed


Sensed = TypeVar("Sensed", Samples, Measurement, "SimulatedRollouts")


def add_noise(samples: Sensed, noise: Noise, rng: np.random.Generator) -> Sensed:
    """White noise and the encoder's steps, as the rig's sensors have them."""

    def noisy(values: np.ndarray | None, sd: float) -> np.ndarray | None:
        return None if values is None else values + sd * rng.standard_normal(values.shape)

    joints = noisy(samples.joint_position, noise.joint_position)
    assert joints is not None
    if noise.encoder_step:
        joints = np.round(joints / noise.encoder_step) * noise.encoder_step
    return dataclasses.replace(
        samples,
        joint_position=joints,
        attitude=None if samples.attitude is None else tilted(samples.attitude, noise.attitude, rng),
        angular_velocity=noisy(samples.angular_velocity, noise.angular_velocity),
        linear_acceleration=noisy(samples.linear_acceleration, noise.linear_acceleration),
        position=noisy(samples.position, noise.position),
    )


def tilted(attitude: np.ndarray, sd: float, rng: np.random.Generator) -> np.ndarray:
    """(..., 4) quaternions turned about a random axis, `sd` (rad) about each of the body's."""
    half = sd / 2 * rng.standard_normal((*attitude.shape[:-1], 3))
    turned = multiply(attitude, np.concatenate([np.ones((*half.shape[:-1], 1)), half], axis=-1))
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)
