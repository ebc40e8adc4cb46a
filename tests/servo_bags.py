"""Bags of a servo bench that follows steps."""

from pathlib import Path

import numpy as np

from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model

RIG = "servo_bench"


def steps_bags(folder: Path) -> Path:
    """Four rollouts of 2 s, without noise; returns the folder."""
    model, times = base_model(RIG), np.arange(0.0, 2.0, 0.4)
    commands = [Commands(times, np.random.default_rng(i).uniform(-1, 1, (len(times), 1))) for i in range(4)]
    scenarios = [Scenario("steps", 2.0, seed=i) for i in range(4)]
    rollouts = simulate(model, model.from_unit(np.full(3, 0.4)), scenarios, commands=commands, timestep=0.005)
    for i in range(4):
        write_measurement(folder, rollouts.measurement(0, i, f"steps_{i}", "steps"))
    return folder
