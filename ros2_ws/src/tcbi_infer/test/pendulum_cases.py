"""The double pendulum driven by torque in simulation, for tests: known truth, known noise."""

import dataclasses

import numpy as np

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

NOISE = 0.001  # rad
MODEL = base_model("double_pendulum").with_effect("viscous_damping")
VALUES = np.array([p.nominal for p in MODEL.parameters])
TIMES = 0.5 + np.arange(12) * 0.3  # s, of the steps: no torque before


def swing(kinds: int = 4, repeats: int = 2) -> list[Measurement]:
    """Torques in steps up to 1.5 N m, each kind `repeats` times, from a posture far from zero."""
    rng = np.random.default_rng(0)
    commands = [Commands(TIMES, rng.uniform(-1.5, 1.5, (len(TIMES), 2)), 0.0) for _ in range(kinds)]
    scenarios = [Scenario("log", 4.0, settle=0.0, initial_joint_position=(0.8, -0.4))] * kinds
    out = simulate(MODEL, VALUES[None], scenarios, commands=commands)
    recordings = []
    for k in range(kinds):
        clean = out.measurement(0, k)
        for repeat in range(repeats):
            noisy = clean.joint_position + rng.normal(0, NOISE, clean.joint_position.shape)
            told = {"rollout_id": f"swing{k}_{repeat}", "policy_id": f"swing{k}", "commands": commands[k]}
            recordings.append(dataclasses.replace(clean, joint_position=noisy, **told))
    return recordings
