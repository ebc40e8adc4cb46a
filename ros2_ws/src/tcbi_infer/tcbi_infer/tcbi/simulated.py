"""Simulated rollouts as a robot would have recorded them: on the grid of the real ones, and with its sensors' noise."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_infer.statistics import RolloutArrays
from tcbi_infer.tcbi.rollouts import Group
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import progress, quaternion_from_rpy
from tcbi_sim.rig import Noise
from tcbi_sim.sensing import multiply


def as_arrays(rollouts: SimulatedRollouts, group: Group, closed: bool) -> RolloutArrays:
    """Simulated rollouts on the grid of the group's real ones, with the commands that they were given."""
    n, length, real = len(rollouts.joint_position), len(group.time), group.arrays
    time, target = real.command_time, np.broadcast_to(real.command_target, (n, *real.command_target.shape[1:]))
    if closed:
        target = rollouts.commands_given
        time = np.broadcast_to(rollouts.command_time, target.shape[1:3])

    def cut(values: np.ndarray | None, measured: np.ndarray | None) -> np.ndarray | None:
        return None if values is None or measured is None else values[:, :, :length]

    return dataclasses.replace(
        real,
        joint_position=rollouts.joint_position[:, :, :length],
        command_time=time,
        command_target=target,
        attitude=cut(rollouts.attitude, real.attitude),
        angular_velocity=cut(rollouts.angular_velocity, real.angular_velocity),
        contact=cut(rollouts.contact, real.contact),
        position=cut(rollouts.position, real.position),
        distance=_distance(rollouts, real, length),
    )


def _distance(rollouts: SimulatedRollouts, real: RolloutArrays, length: int) -> np.ndarray | None:
    """(N, S) m where the real rollouts have one."""
    if rollouts.position is None or real.distance is None:
        return None
    heading = np.array([scenario.initial_yaw for scenario in real.scenarios])
    return np.where(np.isnan(real.distance), np.nan, progress(rollouts.position[:, :, :length], heading)[..., -1])


def with_noise(arrays: RolloutArrays, noise: Noise, rngs: Sequence[np.random.Generator]) -> RolloutArrays:
    """Simulated readings with the sensors' white noise and encoder steps, each particle from its own generator."""

    def noisy(values: np.ndarray | None, sd: float) -> np.ndarray | None:
        if values is None or sd == 0:
            return values
        return values + sd * np.stack([rng.standard_normal(values.shape[1:]) for rng in rngs])

    joints = noisy(arrays.joint_position, noise.joint_position)
    assert joints is not None
    if noise.encoder_step > 0:
        joints = np.round(joints / noise.encoder_step) * noise.encoder_step
    attitude = arrays.attitude
    if attitude is not None and noise.attitude > 0:
        roll, pitch = noise.attitude * np.stack(
            [rng.standard_normal((2, *attitude.shape[1:3])) for rng in rngs], axis=1
        )
        attitude = multiply(attitude, quaternion_from_rpy(roll, pitch, np.zeros_like(roll)))
    rates = noisy(arrays.angular_velocity, noise.angular_velocity)
    position = noisy(arrays.position, noise.position)
    return dataclasses.replace(
        arrays, joint_position=joints, attitude=attitude, angular_velocity=rates, position=position
    )
