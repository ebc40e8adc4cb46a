"""Small recordings for the tests."""

import dataclasses
import zlib

import numpy as np

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig


def recording(
    name: str, rig: str = "servo_bench", motion: int = 0, seconds: float = 2.0, slope_roll: float = 0.0
) -> Measurement:
    """One rollout as the rig's own model moves it, with white noise; rollouts of one motion repeat each other."""
    model = base_model(rig)
    joints = np.arange(len(model_joints(rig)))
    time = np.arange(round(seconds / 0.2)) * 0.2
    target = 0.25 * np.sin(2 * np.pi * (0.5 + 0.03 * joints + 0.1 * motion) * time[:, None] + joints * (motion + 1))
    commands = Commands(time, target)
    scenario = Scenario("balance", seconds, slope_roll=slope_roll)
    out = simulate(model, model.mean()[None], [scenario], commands=[commands])
    clean = out.measurement(0, 0, name, f"motion:{motion}")
    noise = np.random.default_rng(zlib.crc32(name.encode())).normal(0, 2e-3, clean.joint_position.shape)
    return dataclasses.replace(clean, commands=commands, source="test", joint_position=clean.joint_position + noise)


def model_joints(rig: str) -> tuple[str, ...]:
    """Names of a rig's joints."""
    return load_rig(rig).joint_names
