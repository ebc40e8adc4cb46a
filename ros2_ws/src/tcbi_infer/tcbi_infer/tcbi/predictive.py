"""Does the robot move as any of the posterior's draws does? What histograms cannot see: the order of events in time.

A servo that answers late, or slowly because its torque is limited, leaves nearly the histogram of a softer one. So the
recorded commands are replayed with draws of the posterior, and joints and attitude are followed through time. If the
robot were one more draw, the nearest prediction would lie about as far from it as from the other draws. This is a
posterior predictive check (Gelman, Meng and Stern 1996) by nearest neighbours: a wide posterior does not hide a shape
that none of its draws has.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from tcbi_infer.statistics import RolloutArrays
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.weights import normalised, resample

DRAWS = 48  # of the posterior: about a generation's simulations
LEAST_DRAWS = 8  # different ones, of which less is no measure of how far apart they lie


class _Traces(NamedTuple):
    """How far N simulations lie from the robot, group by group; rad, float32 (a rollout of 30 s has many samples)."""

    joint_position: tuple[np.ndarray, ...]  # (N, S, T, J) each
    roll_pitch: tuple[np.ndarray, ...]  # (N, S, T, 2) each; none where an attitude was not measured
    valid: np.ndarray  # (N,) bool, False where the simulation diverged

    def join(self, other: "_Traces") -> "_Traces":
        """Both sets of particles, these first."""
        joints = zip(self.joint_position, other.joint_position, strict=True)
        tilts = zip(self.roll_pitch, other.roll_pitch, strict=True)
        return _Traces(
            tuple(map(np.concatenate, joints)), tuple(map(np.concatenate, tilts)),
            np.concatenate([self.valid, other.valid]),
        )  # fmt: skip


def drawn(problem: Problem, log_weights: np.ndarray) -> np.ndarray:
    """(N,) the particles of (M,) log-weights that are simulated for it, each once."""
    return np.unique(resample(np.random.default_rng(problem.seed), normalised(log_weights), DRAWS))


def departures(problem: Problem, unit: np.ndarray, log_weights: np.ndarray) -> dict[str, float]:
    """How many times as far from the nearest prediction as predictions from each other the robot's signals lie.

    Args:
      problem: the real rollouts; their policies do not act here, so that a deviation stays where it arises.
      unit: (M, P) particles in the parameters' unit cube.
      log_weights: (M,).

    Returns:
      For each signal that was measured the root mean square distance over rollouts, time and channels, over the median
      of the draws': about 1 where nothing is wrong. Empty if fewer than `LEAST_DRAWS` simulations end well.
    """
    traces: _Traces = problem.open_loop.simulate(unit[drawn(problem, log_weights)], view=_traces)
    if traces.valid.sum() < LEAST_DRAWS:
        return {}
    signals = {"joint positions": traces.joint_position, "roll and pitch": traces.roll_pitch}
    return {name: _departure(groups, traces.valid) for name, groups in signals.items() if groups}


def _traces(problem: Problem, rollouts: list[RolloutArrays], valid: np.ndarray) -> _Traces:
    """The view of `Problem.simulate`."""
    pairs = [(simulated, group.arrays) for simulated, group in zip(rollouts, problem.groups, strict=True)]
    tilted = all(real.attitude is not None for _, real in pairs)
    joints = ((simulated.joint_position, real.joint_position) for simulated, real in pairs)
    tilts = ((simulated.roll_pitch, real.roll_pitch) for simulated, real in pairs if tilted)
    return _Traces(_apart(joints), _apart(tilts), valid)


def _apart(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    return tuple((simulated - real).astype(np.float32) for simulated, real in pairs)


def _departure(groups: tuple[np.ndarray, ...], valid: np.ndarray) -> float:
    """Of (N, S, T, C) differences from the robot in each group, for (N,) bool simulations; 1 where all are equal."""
    count = int(valid.sum())
    among, apart = np.zeros((count, count)), np.zeros(count)  # squared distances of the draws, and from the robot
    for group in groups:
        for rollout in np.moveaxis(group[valid], 1, 0):
            flat = rollout.reshape(count, -1).astype(float)
            flat = flat[:, np.isfinite(flat).all(axis=0)]
            own = (flat**2).sum(axis=1)
            apart += own
            among += own[:, None] + own - 2 * flat @ flat.T
    np.fill_diagonal(among, np.inf)
    nearest = float(np.median(np.sqrt(np.maximum(among.min(axis=1), 0.0))))
    return float(np.sqrt(np.min(apart))) / nearest if nearest > 0 else 1.0
