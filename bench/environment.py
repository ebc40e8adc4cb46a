"""What the training environment costs beside its physics, and beside Stable-Baselines3's way of having many of them.

./tcbi python bench/environment.py            # seven pairs
./tcbi python bench/environment.py --quick    # three
"""

import functools
import itertools
import statistics
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from engine import main, seconds
from mujoco.batch import Batch
from stable_baselines3.common.vec_env import DummyVecEnv

from tcbi_bringup.commands.bench import figure
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_policy.configuration import PRESETS
from tcbi_policy.environment import TIMESTEP_S, HexapodEnv, HexapodVectorEnv
from tcbi_policy.gaits import Gait
from tcbi_sim.model import base_model

SEED = 1  # of the episodes, the same for all
SINGLES = 8  # of DummyVecEnv, whose cost is proportional to them
MANY = 256  # environments, beside as many as the trainings of the preset step: a batch's fixed costs are shared by all
SETTLE_STEPS = round(1.0 / TIMESTEP_S)


def measure(pairs: int) -> list[dict[str, Any]]:
    """Figures of each task, with as many environments as its training steps, and with many."""
    counts = [(task, count) for task, config in PRESETS["fast"].items() for count in (config.environments, MANY)]
    return [row for task, count in counts for row in figures_of(task, count, pairs)]


def figures_of(task: str, count: int, pairs: int) -> list[dict[str, Any]]:
    """Of one task; every ratio is the median over pairs of runs in turn."""
    model = base_model("hexapod")
    environment = HexapodVectorEnv(model, task, count)
    gait = Gait("steps")
    times = CONTROL_PERIOD_S * np.arange(environment.steps)
    actions = [gait.act(time, np.zeros((count, 21))) / environment.limit for time in times]

    def episodes() -> None:
        """One set of episodes: drawing, settling, control steps with rewards."""
        environment.reset(seed=SEED)
        for action in actions[:-1]:  # the last one would begin the next set
            environment.step(action)

    episodes()
    physics = bare_physics(environment, actions[:-1])
    dummy = DummyVecEnv([functools.partial(HexapodEnv, model, task, k) for k in range(SINGLES)])

    def one_by_one() -> None:
        dummy.reset()
        for action in actions[:-1]:
            dummy.step(action[:SINGLES].astype(np.float32))

    shares, speedups = [], []
    for _ in range(pairs):
        whole = seconds(episodes)
        shares.append(seconds(physics) / whole)
        speedups.append((seconds(one_by_one) / SINGLES) / (whole / count))
    of = f"{task}, {count} environments"
    return [
        figure(f"{of}: share of the environment's time that is physics, median", statistics.median(shares), "1",
               least=0.8),
        figure(f"{of}: DummyVecEnv over single environments to the vector environment, time of a step, median",
               statistics.median(speedups), "1", least=3.0),
    ]  # fmt: skip


def bare_physics(environment: HexapodVectorEnv, actions: list[np.ndarray]) -> Callable[[], None]:
    """MuJoCo alone: the same models on the same ground through the same controls, settling included."""
    environment.reset(seed=SEED)
    own, data = zip(*(environment.simulator.materialise(i) for i in range(environment.num_envs)), strict=True)
    for m in own:
        m.opt.timestep = TIMESTEP_S
    batch = Batch(own[0], len(own))
    batch.set_models(list(own))
    posture = np.array([s.initial_joint_position for s in environment.simulator.scenarios])
    targets = [posture, *(environment.limit * np.clip(a, -1.0, 1.0) for a in actions)]
    steps = round(CONTROL_PERIOD_S / TIMESTEP_S)
    share = np.arange(steps)[None, :, None] / steps
    ramps = [a[:, None] + share * (b - a)[:, None] for a, b in itertools.pairwise(targets)]
    standing = np.repeat(posture[:, None], SETTLE_STEPS, axis=1)

    def run() -> None:
        batch.reset()
        batch.bind("qpos")[...] = [d.qpos for d in data]
        batch.rollout(SETTLE_STEPS, standing)
        for ramp in ramps:
            batch.rollout(steps, ramp, record=("sensordata",))

    return run


if __name__ == "__main__":
    sys.exit(main("environment", __doc__, measure))
