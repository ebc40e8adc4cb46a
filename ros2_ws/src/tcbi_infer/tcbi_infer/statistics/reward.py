"""Reward per control step (one of the paper's three statistics), by the formula that training uses.

Without a position, a task that counts distance has no reward of single steps; the distance at the end still gives the
return, hence the mean reward per step: one sample a rollout.
"""

import numpy as np

from tcbi_infer.statistics.base import RolloutArrays, Statistic
from tcbi_policy.reward import (
    DISTANCE,
    counts_distance,
    has_reward,
    needs_position,
    rows_at_ticks,
    step_rewards,
    terms_of,
)
from tcbi_sim.measurement import progress


def rewards(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, 1, K) reward of each control step, NaN after a rollout's last command; or (N, S, 1, 1) their mean."""
    assert arrays.attitude is not None
    n, s = arrays.count
    whole = arrays.position is None and any(counts_distance(scenario.task) for scenario in arrays.scenarios)
    values = np.full((n, s, 1, 1 if whole else arrays.command_time.shape[1]), np.nan)
    for i, scenario in enumerate(arrays.scenarios):
        given = int(np.isfinite(arrays.command_time[i]).sum())
        if given == 0:
            continue
        rows = rows_at_ticks(arrays.time, arrays.command_time[i, :given])
        moved = None if arrays.position is None else progress(arrays.position[:, i, rows], scenario.initial_yaw)
        start = scenario.initial_joint_position
        previous: np.ndarray | float = 0.0 if start is None else np.asarray(start, float)
        target, terms = arrays.command_target[:, i, :given], terms_of(scenario.task)
        known = tuple(term for term in terms if not (whole and term.name == DISTANCE))
        steps = step_rewards(known, arrays.attitude[:, i, rows], moved, target, previous)
        if not whole:
            values[:, i, 0, :given] = steps
            continue
        values[:, i, 0, 0] = steps.mean(axis=-1)
        if len(known) < len(terms):
            assert arrays.distance is not None
            weight = sum(term.weight for term in terms if term.name == DISTANCE)
            values[:, i, 0, 0] += weight * arrays.distance[:, i] / given
    return values


def lacks(arrays: RolloutArrays) -> str:
    """A reward needs a task that has one, and a position or the distance at the end where it counts distance."""
    tasks = {scenario.task for scenario in arrays.scenarios}
    unknown = sorted(task for task in tasks if not has_reward(task))
    if unknown:
        return f"a task without a reward ({', '.join(unknown)})"
    if arrays.position is None and arrays.distance is None and any(counts_distance(task) for task in tasks):
        return "neither a position nor a distance at the end, of which the reward of this task needs one"
    terms = [term for task in tasks for term in terms_of(task) if term.name != DISTANCE]
    blind = [term.name for term in terms if arrays.position is None and needs_position(term)]
    if blind:
        return f"a position, of which {', '.join(blind)} in the reward of this task is made"
    return ""


STATISTIC = Statistic(
    name="reward",
    unit="1",
    description="reward of each control step; per rollout where only the distance at the end is known",
    needs=("attitude",),
    channels=lambda arrays: ("reward",),
    compute=rewards,
    lacks=lacks,
)
