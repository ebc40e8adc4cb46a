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

A reward is a tuple of terms, each a weight times a quantity of the control step, which follows from the attitude and
the progress at the step's two ends, its action and the one before: training asks for it step by step, rollouts and
inference for all steps at once. A user's own task brings its terms in its file (docs/policies.md): the ones below, or
new ones.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tcbi_contract.errors import describe
from tcbi_contract.names import CONTROL_PERIOD_S, JOINTS
from tcbi_policy.errors import RewardError
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Measurement, progress, roll_pitch_yaw
from tcbi_sim.tasks import find_task, tasks


@dataclass(frozen=True)
class Steps:
    """What a robot can measure of K control steps, over any leading axes; its arrays cannot be written to."""

    attitude: np.ndarray  # (..., K + 1, 4) base in world, w x y z, at the ticks and at the end of the last step
    progress: np.ndarray | None  # (..., K + 1) m along the heading at the start; None where nothing measures it
    action: np.ndarray  # (..., K, J) rad, the joint targets
    before: np.ndarray  # (..., K, J) rad, the targets of the step before; the posture at the start in the first

    def __post_init__(self) -> None:
        for name in ("attitude", "progress", "action", "before"):
            values = getattr(self, name)
            if values is not None:
                values = values.view()
                values.flags.writeable = False  # a term that writes would change what the next one sees
                object.__setattr__(self, name, values)


@dataclass(frozen=True)
class Term:
    """One term of a reward: weight times a quantity."""

    name: str
    weight: float  # per unit
    unit: str  # of the quantity
    formula: str  # of the quantity, for people
    measure: Callable[[Steps], np.ndarray]  # (..., K)


def attitude_error(attitude: np.ndarray) -> np.ndarray:
    """Mean of |roll| and |pitch| (...) in rad of an attitude (..., 4) w x y z."""
    return np.abs(roll_pitch_yaw(attitude)[..., :2]).mean(axis=-1)


def inclination(attitude: np.ndarray) -> np.ndarray:
    """Angle (...) in rad between the body's z axis and the vertical, of an attitude (..., 4) w x y z."""
    _, x, y, _ = np.moveaxis(np.asarray(attitude, float), -1, 0)
    return np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))


def distance_term(weight: float) -> Term:
    """Progress along the heading at the start; without a tracker, a return still follows from the distance at the end.

    Args:
      weight: per m.
    """
    return Term(DISTANCE, weight, "m", "x' - x", _moved)


def _moved(steps: Steps) -> np.ndarray:
    if steps.progress is None:
        raise RewardError(
            "the task counts distance, but no position was measured; give the distance at the end instead"
        )
    return np.diff(steps.progress, axis=-1)


def attitude_term(weight: float) -> Term:
    """Attitude error that the step removes.

    Args:
      weight: per rad.
    """
    return Term("attitude", weight, "rad", "e - e'", lambda s: -np.diff(attitude_error(s.attitude), axis=-1))


def action_term(weight: float) -> Term:
    """Mean squared change of the joint targets.

    Args:
      weight: per rad^2, negative for a cost.
    """
    return Term("action", weight, "rad^2", "mean_j (a_j - a_j_before)^2", _change)


def _change(steps: Steps) -> np.ndarray:
    return np.square(steps.action - steps.before).mean(axis=-1)


TRIAL_STEPS = 10  # of what a term is tried on
DISTANCE = "distance"  # the one term whose sum is known from the end of the rollout alone
REWARDS: dict[str, tuple[Term, ...]] = {
    "balance": (attitude_term(9000.0), action_term(-600.0)),
    "forward": (distance_term(90000.0), attitude_term(9000.0), action_term(-600.0)),
}


def terms_of(task: str) -> tuple[Term, ...]:
    """The terms of a task's reward.

    Raises:
      RewardError: the task has none.
    """
    if task in REWARDS:
        return REWARDS[task]
    if not has_reward(task):
        raise RewardError(describe("task without a reward", task, "one of " + ", ".join(tasks())))
    return find_task(task).reward


def has_reward(task: str) -> bool:
    """Whether a task is known, and with it its reward."""
    return task in REWARDS or task in tasks()


def counts_distance(task: str) -> bool:
    """Whether a task's reward needs to know how far the robot came."""
    return any(term.name == DISTANCE for term in terms_of(task))


def formula(task: str) -> str:
    """The reward of a control step in a line, with its weights."""
    signs = ["-" if term.weight < 0 else "+" for term in terms_of(task)]
    parts = [f"{abs(term.weight):g} /{term.unit} * ({term.formula})" for term in terms_of(task)]
    return "r = " + " ".join(f"{sign} {part}" for sign, part in zip(signs, parts, strict=True)).removeprefix("+ ")


def needs_position(term: Term) -> bool:
    """Whether a term cannot be measured without a position: found by trying it on a robot at rest, with and without."""
    return not _measurable(term, None) and _measurable(term, np.zeros(TRIAL_STEPS + 1))


def _measurable(term: Term, progress: np.ndarray | None) -> bool:
    rest = np.zeros((TRIAL_STEPS, len(JOINTS)))
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (TRIAL_STEPS + 1, 1))
    try:
        term.measure(Steps(attitude, progress, rest, rest))
    except Exception:  # noqa: BLE001 - it is the user's code, which may raise anything
        return False
    return True


def step_rewards(
    task: str | tuple[Term, ...],
    attitude: np.ndarray,
    progress: np.ndarray | None,
    action: np.ndarray,
    previous: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Reward of each control step, over any leading axes.

    Args:
      task: a task's name, or terms.
      attitude: (..., K + 1, 4) base in world, w x y z, at the K control ticks and at the end of the last step.
      progress: (..., K + 1) m along the heading at the start; None where the task does not count it.
      action: (..., K, J) joint targets in rad.
      previous: (..., J) joint targets before the first step in rad (the posture at the start).

    Returns:
      (..., K) rewards, NaN where an input is NaN.

    Raises:
      RewardError: a term needs the position and `progress` is None.
    """
    before = np.concatenate([np.broadcast_to(previous, action[..., :1, :].shape[:-2] + action.shape[-1:])[..., None, :],
                             action[..., :-1, :]], axis=-2)  # fmt: skip
    steps = Steps(attitude, progress, action, before)
    reward = np.zeros(action.shape[:-1])
    for term in terms_of(task) if isinstance(task, str) else task:
        if progress is None and term.name != DISTANCE and needs_position(term):
            raise RewardError(
                f"term {term.name!r} of the reward needs the position, but none was measured; add a tracker"
            )
        reward = reward + term.weight * term.measure(steps)
    return reward


@dataclass(frozen=True)
class EpisodeReward:
    """The reward of one rollout."""

    steps: np.ndarray  # (K,) per control step; NaN where the position was not measured and a term needs it
    total: float  # the return; NaN if neither a position nor, where that is enough, a distance was measured


def episode_reward(measurement: Measurement) -> EpisodeReward:
    """The reward of a rollout, from what the robot can measure.

    Without a tracker, or with one that had lost the robot at the start or the end, a task that counts distance has no
    step rewards but still a return, from the distance at the end; one with another term that needs the position has
    neither.

    Raises:
      RewardError: no attitude, or no command, was measured.
    """
    terms = terms_of(measurement.scenario.task)
    commands = measurement.commands
    if measurement.attitude is None or len(measurement.attitude) == 0 or len(commands.time) == 0:
        lack = "attitude" if len(commands.time) else "commands"
        raise RewardError(f"rollout {measurement.rollout_id}: no {lack} recorded, so it has no reward")
    rows = rows_at_ticks(measurement.time, commands.time)
    start = measurement.scenario.initial_joint_position
    previous = np.zeros(commands.target.shape[1]) if start is None else np.asarray(start, float)
    attitude = measurement.attitude[rows]
    moved = None
    if measurement.position is not None and _tracked_at_both_ends(measurement, rows):
        moved = progress(measurement.position[rows], measurement.scenario.initial_yaw)
    missing = tuple(t for t in terms if moved is None and (t.name == DISTANCE or needs_position(t)))
    known = tuple(term for term in terms if term not in missing)
    steps = step_rewards(known, attitude, moved, commands.target, previous)
    if not missing:
        return EpisodeReward(steps, float(steps.sum()))
    end = sum(term.weight * measurement.distance if term.name == DISTANCE else np.nan for term in missing)
    return EpisodeReward(np.full(len(commands.time), np.nan), float(steps.sum() + end))


def _tracked_at_both_ends(measurement: Measurement, rows: np.ndarray) -> bool:
    """Whether a tracker saw the robot at the first and the last of the samples `rows`, between which it walked."""
    assert measurement.position is not None
    ends = rows[[0, -1]]
    lost = [
        begin <= time <= end
        for name, begin, end in measurement.gaps
        if name == "position"
        for time in measurement.time[ends]
    ]
    return bool(np.isfinite(measurement.position[ends]).all()) and not any(lost)


def rows_at_ticks(sample_time: np.ndarray, command_time: np.ndarray) -> np.ndarray:
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
    rows = rows_at_ticks(rollouts.time, rollouts.command_time)
    attitude, way = rollouts.attitude[:, :, rows], progress(rollouts.position[:, :, rows], heading)
    rewards = np.full((*shape, len(rollouts.command_time)), np.nan)
    for task in sorted({s.task for s in rollouts.scenarios}):
        mine = np.vectorize(lambda s, task=task: s.task == task)(scenarios) & ~rollouts.diverged
        rewards[mine] = step_rewards(task, attitude[mine], way[mine], rollouts.commands_given[mine], previous[mine])
    ends = np.array([s.duration for s in scenarios.ravel()]).reshape(*shape, 1)
    return np.where(rollouts.command_time < ends - 1e-9, rewards, np.nan)
