"""Rollouts with known content, for the tests of bags."""

import math

import numpy as np

from tcbi_contract.names import JOINTS, LEGS
from tcbi_sim.measurement import Block, Commands, Measurement, Scenario


def rollout(rollout_id: str = "walk_1", samples: int = 101, seed: int = 0, rate: float = 50.0) -> Measurement:
    """A hexapod's rollout of random values, with every signal."""
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / rate
    attitude = rng.normal(size=(samples, 4)) * 0.01 + np.array([1.0, 0, 0, 0])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    commands = np.arange(0, time[-1], 0.2)
    return Measurement(
        rollout_id=rollout_id,
        rig="hexapod",
        scenario=Scenario(
            task="forward",
            duration=float(time[-1]),
            slope_roll=0.1,
            slope_pitch=-0.05,
            blocks=(Block((0.3, 0.1, 0.035), (0.15, 0.12, 0.07), 0.4), Block((0.6, -0.1, 0.03), (0.1, 0.1, 0.06))),
            initial_joint_position=tuple(rng.uniform(-0.2, 0.2, len(JOINTS))),
            initial_yaw=0.25,
            seed=seed,
            constants=(("battery", 7.4),),
        ),
        policy_id="gait:tripod",
        source="sim",
        commands=Commands(np.round(commands, 9), rng.uniform(-0.4, 0.4, (len(commands), len(JOINTS))), 0.2),
        joint_names=JOINTS,
        foot_names=LEGS,
        time=time,
        joint_position=rng.uniform(-0.5, 0.5, (samples, len(JOINTS))),
        attitude=attitude,
        angular_velocity=rng.normal(size=(samples, 3)),
        linear_acceleration=rng.normal(size=(samples, 3)) + np.array([0, 0, 9.81]),
        contact=rng.random((samples, len(LEGS))) < 0.5,
        position=np.cumsum(rng.normal(size=(samples, 3)) * 0.01, axis=0),
        distance=1.25,
    )


def bench(rollout_id: str = "kp100", samples: int = 200) -> Measurement:
    """A servo bench's rollout: one joint, irregular times, torque switched off half way."""
    rng = np.random.default_rng(5)
    time = np.round(np.cumsum(rng.uniform(0.004, 0.006, samples)), 9)
    commands = time[::4]
    return Measurement(
        rollout_id=rollout_id,
        rig="servo_bench",
        scenario=Scenario(
            "log", float(time[-1]), initial_joint_position=(0.1,), constants=(("kp", 100.0), ("mass", 0.49))
        ),
        policy_id="",
        source="bench",
        commands=Commands(commands, np.sin(commands)[:, None], 0.0, commands < time[-1] / 2),
        joint_names=("servo",),
        foot_names=(),
        time=time,
        joint_position=np.sin(time)[:, None] + rng.normal(size=(samples, 1)) * 1e-3,
    )


def differences(a: Measurement, b: Measurement) -> list[str]:
    """The names of fields in which two measurements differ in any bit, `notes` apart."""
    different = []
    for name in a.__dataclass_fields__:
        if name == "notes":
            continue
        x, y = getattr(a, name), getattr(b, name)
        if name == "commands":
            different += [f"commands.{n}" for n in x.__dataclass_fields__ if not _same(getattr(x, n), getattr(y, n))]
        elif not _same(x, y):
            different.append(name)
    return different


def _same(x: object, y: object) -> bool:
    if isinstance(x, dict) and isinstance(y, dict):
        return x.keys() == y.keys() and all(_same(a, b) for k in x for a, b in zip(x[k], y[k], strict=True))
    if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
        return x is not None and y is not None and np.array_equal(np.asarray(x), np.asarray(y))
    if isinstance(x, float) and isinstance(y, float) and math.isnan(x):
        return math.isnan(y)
    return x == y
