"""Short motions of the hexapod as its own simulation moves it, for tests: known truth, known noise."""

import dataclasses

import numpy as np

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model, base_model

NOISE = 0.002  # rad, m


def motions(count: int = 2, duration: float = 2.4) -> list[Commands]:
    """Targets of 0.2 s for every joint, each joint at its own pace."""
    t = np.arange(round(duration / 0.2)) * 0.2
    joints = np.arange(18)
    return [
        Commands(t, 0.25 * np.sin(2 * np.pi * (0.5 + 0.03 * joints + 0.1 * k) * t[:, None] + joints * (k + 1)))
        for k in range(count)
    ]


def walk(
    model: Model | None = None,
    values: np.ndarray | None = None,
    repeats: int = 2,
    count: int = 2,
    timestep: float = 0.002,
) -> list[Measurement]:
    """Every motion `repeats` times: simulated at some steps (s), with white noise on joints and tracker."""
    model = model or base_model("hexapod")
    values = model.mean() if values is None else values
    rng = np.random.default_rng(0)
    commands = motions(count)
    scenarios = [Scenario("balance", 2.4, slope_roll=0.1 * k) for k in range(count)]
    out = simulate(model, values[None], scenarios, commands=commands, timestep=timestep)
    return [
        noisy(out.measurement(0, s), commands[s], s, repeat, rng) for s in range(count) for repeat in range(repeats)
    ]


def noisy(clean: Measurement, commands: Commands, motion: int, repeat: int, rng: np.random.Generator) -> Measurement:
    """One recording of a motion."""
    assert clean.position is not None
    return dataclasses.replace(
        clean,
        rollout_id=f"motion{motion}_{repeat}",
        policy_id=f"motion{motion}",
        commands=commands,
        joint_position=clean.joint_position + rng.normal(0, NOISE, clean.joint_position.shape),
        position=clean.position + rng.normal(0, NOISE, clean.position.shape),
    )
