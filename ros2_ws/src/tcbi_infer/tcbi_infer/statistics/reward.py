"""Reward per control step (one of the paper's three statistics), by the formula that training uses."""

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_infer.statistics.base import RolloutArrays, Statistic
from tcbi_policy.reward import counts_distance, has_reward, progress, step_rewards


def rewards(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, 1, K) reward of each control step; NaN after a rollout's last command."""
    assert arrays.attitude is not None
    n, s = arrays.count
    values = np.full((n, s, 1, arrays.command_time.shape[1]), np.nan)
    for i, scenario in enumerate(arrays.scenarios):
        given = int(np.isfinite(arrays.command_time[i]).sum())
        if given == 0:
            continue
        ticks = np.append(arrays.command_time[i, :given], arrays.command_time[i, given - 1] + CONTROL_PERIOD_S)
        rows = np.clip(np.searchsorted(arrays.time, ticks + 1e-6, "right") - 1, 0, len(arrays.time) - 1)
        moved = None if arrays.position is None else progress(arrays.position[:, i, rows], scenario.initial_yaw)
        start = scenario.initial_joint_position
        previous: np.ndarray | float = 0.0 if start is None else np.asarray(start, float)
        target = arrays.command_target[:, i, :given]
        values[:, i, 0, :given] = step_rewards(scenario.task, arrays.attitude[:, i, rows], moved, target, previous)
    return values


def lacks(arrays: RolloutArrays) -> str:
    """A reward needs a task that has one, and a position where the task counts distance."""
    tasks = {scenario.task for scenario in arrays.scenarios}
    unknown = sorted(task for task in tasks if not has_reward(task))
    if unknown:
        return f"a task without a reward ({', '.join(unknown)})"
    if arrays.position is None and any(counts_distance(task) for task in tasks):
        return "no position, which the reward per step of this task needs"
    return ""


STATISTIC = Statistic(
    name="reward",
    unit="1",
    description="reward of each control step",
    needs=("attitude",),
    channels=lambda arrays: ("reward",),
    compute=rewards,
    lacks=lacks,
)
