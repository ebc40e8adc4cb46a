"""What the task is about, measured and predicted alike: distance and reward over time, and one figure a rollout.

Signals (`distance`, `reward`) have many values in a rollout; statistics (`return`, `final_inclination`, `distance_end`,
`contact_ratio_<foot>`) have one. What a rollout did not measure, or its task has not, is NaN.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_infer.compare.noise import from_fast_changes, scatter
from tcbi_infer.compare.replay import Replay
from tcbi_infer.gaps import unusable
from tcbi_policy.errors import RewardError
from tcbi_policy.reward import inclination, progress, rows_at_ticks, step_rewards
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Commands, Scenario

DISTANCE, REWARD = "distance", "reward"
SIGNALS = (DISTANCE, REWARD)
UNITS = {DISTANCE: "m", REWARD: "1", "return": "1", "final_inclination": "deg", "distance_end": "m"}
LEAST = {  # smallest noise floor credible, in the unit
    DISTANCE: 5e-4, REWARD: 1.0, "return": 1.0, "final_inclination": 0.03, "distance_end": 5e-4
}  # fmt: skip
LEAST_SHARE = 0.01  # of a contact ratio
FEWEST_REPEATS = 4  # beyond the first of each motion, whose scatter is the floor: of fewer it is too rough
FEWEST_ROLLOUTS = 3  # from whose scatter a statistic's floor can be estimated
Values = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class TaskFloor:
    """Noise floor of one task signal or statistic; NaN where these rollouts cannot tell."""

    value: float
    from_replicates: bool


def unit(name: str) -> str:
    """Unit of a task signal or statistic."""
    return UNITS.get(name, "share")


def measured(replay: Replay) -> Values:
    """name -> (R, K), what the rollouts say; K is 1 for statistics."""
    each = []
    for r, m in enumerate(replay.measurements):
        values = _values(replay, r, m.commands, m.attitude, m.contact, m.position)
        if m.position is None and np.isfinite(m.distance) and compared(replay)[r, -1]:
            values["distance_end"] = np.array([m.distance])  # the operator's entry
        each.append(values)
    return _stacked(replay, each)


def predicted(replay: Replay, rollouts: SimulatedRollouts, sets: Sequence[int]) -> tuple[Values, np.ndarray]:
    """What simulations of some replicate sets say.

    Returns:
      name -> (N, R', K), K as in `measured`, and the (R',) numbers of the rollouts: the members of these sets.
    """
    each, owners = [], []
    length = len(replay.time)

    def tail(values: np.ndarray | None, s: int) -> np.ndarray | None:
        return None if values is None else values[:, s, -length:]

    for s, number in enumerate(sets):
        arrays = [tail(v, s) for v in (rollouts.attitude, rollouts.contact, rollouts.position)]
        for r in replay.replicates[number].members:
            values = _values(replay, r, replay.commands[number], *arrays)
            each.append({k: np.where(rollouts.diverged[:, s, None], np.nan, v) for k, v in values.items()})
            owners.append(r)
    return _stacked(replay, each), np.array(owners)


def compared(replay: Replay) -> np.ndarray:
    """(R, T) bool: which samples of each rollout its statistics are made of: gaps are left out."""
    return np.isfinite(replay.shown[..., 0])


def _values(
    replay: Replay,
    r: int,
    commands: Commands,
    attitude: np.ndarray | None,
    contact: np.ndarray | None,
    position: np.ndarray | None,
) -> Values:
    """Signals and statistics of one rollout; arrays are (..., T, width), results (..., K).

    What the gaps of a signal leave out is left out of a prediction too. A distance counts from the first sample, so
    that without it there is none.
    """
    m, good = replay.measurements[r], compared(replay)[r]
    if not good.any():
        return {}
    scenario = m.scenario
    first, last = (int(np.nonzero(good)[0][i]) for i in (0, -1))
    gaps = unusable(m, replay.time).signals
    there = {name: good & ~gaps[name] if name in gaps else good for name in ("attitude", "contact", "position")}
    whole = {name: bool(seen[first : last + 1].all()) for name, seen in there.items()}
    values: Values = {}
    if position is not None and there["position"][first]:
        moved = progress(position, scenario.initial_yaw)
        values[DISTANCE] = np.where(there["position"], moved, np.nan)
        values["distance_end"] = values[DISTANCE][..., last : last + 1]
    if attitude is not None:
        end = np.where(there["attitude"][last], inclination(attitude[..., last : last + 1, :]), np.nan)
        values["final_inclination"] = np.degrees(end)
        way = position if whole["position"] else None
        reward = _rewards(replay.time[: last + 1], scenario, commands, attitude, way)
        if reward is not None and whole["attitude"]:
            values[REWARD], values["return"] = reward, np.nansum(reward, axis=-1, keepdims=True)
    if contact is not None and there["contact"].any():
        share = np.where(there["contact"][:, None], contact, np.nan)
        ratio = np.nanmean(share, axis=-2)
        for f, foot in enumerate(m.foot_names):
            values[f"contact_ratio_{foot}"] = ratio[..., f, None]
    return values


def _rewards(
    time: np.ndarray, scenario: Scenario, commands: Commands, attitude: np.ndarray, position: np.ndarray | None
) -> np.ndarray | None:
    """(..., K) of each control step that ended; None where the task has no reward or needs what is missing."""
    if not len(commands.time):
        return None
    rows = rows_at_ticks(time, commands.time)
    start = scenario.initial_joint_position
    before: np.ndarray | float = 0.0 if start is None else np.asarray(start, float)
    moved = None if position is None else progress(position, scenario.initial_yaw)[..., rows]
    try:
        reward = step_rewards(scenario.task, attitude[..., rows, :], moved, commands.target, before)
    except RewardError:  # the task has none, or needs a position
        return None
    ends = np.append(commands.time[1:], commands.time[-1] + CONTROL_PERIOD_S)
    return np.where(ends < time[-1] + 0.5 * CONTROL_PERIOD_S, reward, np.nan)


def _stacked(replay: Replay, each: Sequence[Values]) -> Values:
    """One array for each name, rollouts second to last, filled up with NaN to one width for the whole replay."""
    width = {DISTANCE: len(replay.time), REWARD: max(len(c.time) for c in replay.commands)}
    names = dict.fromkeys(name for values in each for name in values)
    result = {}
    for name in names:
        first = next(v[name] for v in each if name in v)
        rows = []
        for values in each:
            row = np.full((*first.shape[:-1], width.get(name, 1)), np.nan)
            if name in values:
                row[..., : values[name].shape[-1]] = values[name]
            rows.append(row)
        result[name] = np.stack(rows, axis=-2)
    return result


def least(name: str) -> float:
    """The smallest noise floor of a task signal or statistic that is credible, in its unit."""
    return LEAST.get(name, LEAST_SHARE)


def floors(replay: Replay, observed: Values, mean: Values) -> dict[str, TaskFloor]:
    """The noise floor of each task signal and statistic.

    Args:
      replay: the rollouts.
      observed: name -> (R, K).
      mean: name -> (R, K) predicted.
    """
    return {
        name: _floor(
            values,
            values - mean[name],
            replay.repeats,
            least(name),
            replay.readings if name == DISTANCE else None,
        )
        for name, values in observed.items()
        if name in mean
    }


def _floor(
    values: np.ndarray,
    residual: np.ndarray,
    repeats: Sequence[Sequence[int]],
    least: float,
    readings: np.ndarray | None,
) -> TaskFloor:
    squares, freedom = 0.0, 0
    for members in repeats:
        square, free = scatter(values[list(members)])
        squares, freedom = squares + float(square.sum()), freedom + int(free.sum())
    if freedom >= FEWEST_REPEATS:
        return TaskFloor(max(float(np.sqrt(squares / freedom)), least), True)
    if values.shape[-1] > 1:
        return TaskFloor(max(float(from_fast_changes(residual[..., None], readings)[0]), least), False)
    distinct = residual[sorted(r for members in repeats for r in members)]
    single = distinct[np.isfinite(distinct)]
    if len(single) < FEWEST_ROLLOUTS:
        return TaskFloor(float("nan"), False)
    return TaskFloor(max(float(np.std(single, ddof=1)), least), False)
