"""Recordings made by the servo bench in simulation, for tests: known truth, known noise."""

import dataclasses

import numpy as np

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model

NOISE = 0.001  # rad
BASE = np.array([5e-3, 0.02, 0.015])  # gain, damping, friction of the bench


def motions() -> dict[str, np.ndarray]:
    """Seven kinds of motion, rad, one target each 0.2 s for 5 s."""
    rng = np.random.default_rng(3)
    t = np.arange(25) * 0.2
    return {
        "sine": 0.8 * np.sin(2 * np.pi * 0.4 * t),
        "fast": 0.5 * np.sin(2 * np.pi * 0.9 * t),
        "steps": np.repeat(rng.uniform(-1, 1, 9), 3)[:25],
        "ramp": np.linspace(0, 1.5, 25),
        "chirp": 0.6 * np.sin(2 * np.pi * (0.1 * t + 0.1 * t * t)),
        "walk": np.cumsum(rng.normal(0, 0.25, 25)).clip(-1.5, 1.5),
        "saw": (t % 1.6) / 1.6 - 0.3,
    }


def record(model: Model, values: np.ndarray, seed: int = 0, repeats: int = 2) -> list[Measurement]:
    """Every motion, recorded `repeats` times with noise of `NOISE`, at 1 ms steps."""
    rng = np.random.default_rng(seed)
    names = list(motions())
    commands = [Commands(np.arange(25) * 0.2, m[:, None]) for m in motions().values()]
    scenarios = [Scenario("log", 5.0, settle=0.0) for _ in names]
    out = simulate(model, values[None], scenarios, commands=commands, timestep=0.001)
    recordings = []
    for s, name in enumerate(names):
        clean = out.measurement(0, s)
        for repeat in range(repeats):
            noisy = clean.joint_position + rng.normal(0, NOISE, clean.joint_position.shape)
            recordings.append(
                dataclasses.replace(
                    clean, rollout_id=f"{name}_{repeat}", policy_id=name, commands=commands[s], joint_position=noisy
                )
            )
    return recordings
