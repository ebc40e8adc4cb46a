"""The reward of a control step: one formula with units that training, rollouts and inference share.

    r_k =  w_distance * (x_{k+1} - x_k)                      w_distance: 90000 per m
         + w_attitude * (e_k - e_{k+1})                      w_attitude:  9000 per rad
         + w_action   * mean_j (a_{k,j} - a_{k-1,j})^2       w_action:    -600 per rad^2

at 5 Hz, where x is the progress along the heading at the start (m), e = (|roll| + |pitch|) / 2 the attitude error of
the torso against gravity (rad), a the joint targets (rad), and a_{-1} the posture at the start.

The weights are Table 2 of the paper; it names the three terms (section 3) without a formula. Why this one:

- Progress terms telescope: the return is 90000 d + 9000 (e_0 - e_end) - cost whatever happened in between, so that the
  distance that an operator reads off a tape measure is enough for the return of a real rollout.
- *Forward.* With 90000 per metre, the returns of Table 5 leave costs of 125 to 165 a step, hence joint targets that
  change by 0.46 to 0.52 rad (root mean square) each 0.2 s: a brisk gait within the range of +-0.52 rad.
- *Balance.* In Table 4 the return falls by 82 per degree of final inclination. The mean of the two axes falls by
  79 (tilt about one axis) to 111 (about a diagonal) per degree; the full inclination would fall by 157.
- The cost is on the change of the targets, not on their size: standing on a slope with bent legs is then free, as it
  must be for a robot that is asked to stand level there.
- Balance has no distance term: at 90000 per metre, creeping downhill would pay more than standing level.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_contract.errors import describe
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_policy.errors import RewardError
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Measurement, roll_pitch_yaw


@dataclass(frozen=True)
class RewardWeights:
    """What one unit of each term is worth."""

    distance: float  # per m of progress along the heading at the start
    attitude: float  # per rad of attitude error removed
    action: float  # per rad^2 of mean squared change of the joint targets


WEIGHTS = {
    "balance": RewardWeights(distance=0.0, attitude=9000.0, action=-600.0),
    "forward": RewardWeights(distance=90000.0, attitude=9000.0, action=-600.0),
}


def weights_of(task: str) -> RewardWeights:
    """The weights of a task.

    Raises:
      RewardError: the task has none.
    """
    if task not in WEIGHTS:
        raise RewardError(describe("task without a reward", task, "one of " + ", ".join(WEIGHTS)))
    return WEIGHTS[task]


def attitude_error(attitude: np.ndarray) -> np.ndarray:
    """Mean of |roll| and |pitch| (...) in rad of an attitude (..., 4) w x y z."""
    return np.abs(roll_pitch_yaw(attitude)[..., :2]).mean(axis=-1)


def inclination(attitude: np.ndarray) -> np.ndarray:
    """Angle (...) in rad between the body's z axis and the vertical, of an attitude (..., 4) w x y z."""
    _, x, y, _ = np.moveaxis(np.asarray(attitude, float), -1, 0)
    return np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))


def progress(position: np.ndarray, heading: np.ndarray | float = 0.0) -> np.ndarray:
    """Displacement (..., T) in m along the heading at the start (rad) of positions (..., T, 3) in m."""
    moved = position[..., :2] - position[..., :1, :2]
    heading = np.asarray(heading, float)[..., None]
    return moved[..., 0] * np.cos(heading) + moved[..., 1] * np.sin(heading)


def step_rewards(
    task: str | RewardWeights,
    attitude: np.ndarray,
    progress: np.ndarray | None,
    action: np.ndarray,
    previous: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Reward of each control step, over any leading axes.

    Args:
      task: a task's name, or weights.
      attitude: (..., K + 1, 4) base in world, w x y z, at the K control ticks and at the end of the last step.
      progress: (..., K + 1) m along the heading at the start; None where the task does not count it.
      action: (..., K, J) joint targets in rad.
      previous: (..., J) joint targets before the first step in rad (the posture at the start).

    Returns:
      (..., K) rewards, NaN where an input is NaN.

    Raises:
      RewardError: the task counts distance and `progress` is None.
    """
    w = task if isinstance(task, RewardWeights) else weights_of(task)
    before = np.concatenate([np.broadcast_to(previous, action[..., :1, :].shape[:-2] + action.shape[-1:])[..., None, :],
                             action[..., :-1, :]], axis=-2)  # fmt: skip
    reward = w.action * np.square(action - before).mean(axis=-1)
    reward = reward - w.attitude * np.diff(attitude_error(attitude), axis=-1)
    if w.distance == 0.0:
        return reward
    if progress is None:
        raise RewardError(
            "the task counts distance, but no position was measured; give the distance at the end instead"
        )
    return reward + w.distance * np.diff(progress, axis=-1)


@dataclass(frozen=True)
class EpisodeReward:
    """The reward of one rollout."""

    steps: np.ndarray  # (K,) per control step; NaN where the position was not measured and the task counts it
    total: float  # the return; NaN if neither a position nor a distance was measured


def episode_reward(measurement: Measurement) -> EpisodeReward:
    """The reward of a rollout, from what the robot can measure.

    Without a tracker, a task that counts distance has no step rewards but still a return, from the distance at the end.

    Raises:
      RewardError: no attitude, or no command, was measured.
    """
    weights = weights_of(measurement.scenario.task)
    commands = measurement.commands
    if measurement.attitude is None or len(measurement.attitude) == 0 or len(commands.time) == 0:
        lack = "attitude" if len(commands.time) else "commands"
        raise RewardError(f"rollout {measurement.rollout_id}: no {lack} recorded, so it has no reward")
    rows = _rows_at_ticks(measurement.time, commands.time)
    start = measurement.scenario.initial_joint_position
    previous = np.zeros(commands.target.shape[1]) if start is None else np.asarray(start, float)
    attitude = measurement.attitude[rows]
    if measurement.position is not None or weights.distance == 0.0:
        moved = None
        if measurement.position is not None:
            moved = progress(measurement.position[rows], measurement.scenario.initial_yaw)
        steps = step_rewards(weights, attitude, moved, commands.target, previous)
        return EpisodeReward(steps, float(steps.sum()))
    rest = RewardWeights(0.0, weights.attitude, weights.action)
    total = (
        step_rewards(rest, attitude, None, commands.target, previous).sum() + weights.distance * measurement.distance
    )
    return EpisodeReward(np.full(len(commands.time), np.nan), float(total))


def _rows_at_ticks(sample_time: np.ndarray, command_time: np.ndarray) -> np.ndarray:
    """Row (K + 1,) of the newest sample at each control tick and at the end of the last step."""
    ticks = np.append(command_time, command_time[-1] + CONTROL_PERIOD_S)
    rows = np.searchsorted(sample_time, ticks + 1e-6, side="right") - 1
    return np.clip(rows, 0, len(sample_time) - 1)


def simulated_rewards(rollouts: SimulatedRollouts) -> np.ndarray:
    """Rewards (N, S, K) of each control step of simulated rollouts; NaN where one diverged or had ended already."""
    shape = rollouts.diverged.shape
    paired = shape[1] == 1 and len(rollouts.scenarios) == shape[0]
    scenarios = np.array(rollouts.scenarios, object).reshape((-1, 1) if paired else (1, -1))
    scenarios = np.broadcast_to(scenarios, shape)
    assert rollouts.attitude is not None and rollouts.position is not None
    joints = rollouts.joint_position.shape[-1]
    starts = [s.initial_joint_position or np.zeros(joints) for s in scenarios.ravel()]
    previous = np.array(starts, float).reshape(*shape, joints)
    heading = np.array([s.initial_yaw for s in scenarios.ravel()]).reshape(shape)
    rows = _rows_at_ticks(rollouts.time, rollouts.command_time)
    attitude, way = rollouts.attitude[:, :, rows], progress(rollouts.position[:, :, rows], heading)
    rewards = np.full((*shape, len(rollouts.command_time)), np.nan)
    for task in sorted({s.task for s in rollouts.scenarios}):
        mine = np.vectorize(lambda s, task=task: s.task == task)(scenarios) & ~rollouts.diverged
        rewards[mine] = step_rewards(task, attitude[mine], way[mine], rollouts.commands_given[mine], previous[mine])
    ends = np.array([s.duration for s in scenarios.ravel()]).reshape(*shape, 1)
    return np.where(rollouts.command_time < ends - 1e-9, rewards, np.nan)
