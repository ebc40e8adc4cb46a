"""What trajectory-based methods see: how far simulated trajectories lie from the recorded ones, sample by sample.

The observations are the paper's state, joint angles and (where measured) roll and pitch; a rollout is compared with the
simulation of the same scenario. Equation 8's sums over time are kept for each observation apart, as means, so that
weights W can be set afterwards and the trajectories themselves dropped. Beside them stands BayesSim's summary of a
rollout (Ramos et al. 2019, section IV): means and variances of the state's differences over a control period, and
each joint's product with what it lacked of its command (BayesSim: every state's with every action).
"""

from typing import NamedTuple

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_infer.statistics import RolloutArrays
from tcbi_infer.tcbi.problem import Problem, Simulated

STATISTIC = "trajectory"  # under which its distance stands where other methods have their divergences


class Trajectories(NamedTuple):
    """Rollouts of M particles against the recorded ones; O observations."""

    absolute: np.ndarray  # (M, O) mean absolute difference, rad
    square: np.ndarray  # (M, O) mean squared difference, rad^2
    summary: np.ndarray  # (M, K)
    valid: np.ndarray  # (M,) bool, False where the simulation diverged

    def join(self, other: "Trajectories") -> "Trajectories":
        """Both sets of particles, these first."""
        return Trajectories(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def nothing(real: Trajectories) -> Trajectories:
    """No particle yet, in the shapes of these."""
    return Trajectories(*(np.zeros((0, *part.shape[1:]), part.dtype) for part in real))


def observe(problem: Problem) -> Trajectories:
    """The recorded rollouts themselves, as one particle."""
    measured = [group.arrays for group in problem.groups]
    return trajectories(problem, Simulated(measured, measured, np.ones(1, bool)))


def trajectories(problem: Problem, simulated: Simulated) -> Trajectories:
    """The view of `Problem.simulate` for trajectory-based methods."""
    attitude = all(group.arrays.attitude is not None for group in problem.groups)
    parts = []
    for group, arrays in zip(problem.groups, simulated.readings, strict=True):
        real = _state(group.arrays, attitude)
        measured = np.isfinite(real)
        difference = np.where(measured, _state(arrays, attitude) - real, 0.0)
        known = np.isfinite(_summary(group.arrays, attitude, problem.rate))
        summary = np.where(known, _summary(arrays, attitude, problem.rate), 0.0)
        sums = np.abs(difference).sum(axis=(1, 2)), (difference**2).sum(axis=(1, 2)), summary.sum(axis=1)
        parts.append((*sums, measured.sum(axis=(1, 2)), known.sum(axis=1)))
    absolute, square, summary, samples, count = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
    samples, count = np.maximum(samples, 1), np.maximum(count, 1)
    return Trajectories(absolute / samples, square / samples, summary / count, simulated.valid)


def _state(arrays: RolloutArrays, attitude: bool) -> np.ndarray:
    """(N, S, T, O) joint angles, then roll and pitch, rad."""
    parts = [arrays.joint_position, *([arrays.roll_pitch] if attitude else [])]
    return np.concatenate(parts, axis=-1)


def _summary(arrays: RolloutArrays, attitude: bool, rate: float) -> np.ndarray:
    """(N, S, 2 O + J) of each rollout: mean and variance of differences, and their mean product with the command."""
    period = max(1, round(CONTROL_PERIOD_S * rate))
    state = _state(arrays, attitude)[:, :, ::period]
    moved = np.diff(state, axis=2)
    joints = arrays.joint_position[:, :, ::period]
    index = np.maximum(arrays.latest_command[:, ::period], 0)
    wanted = arrays.command_target[:, np.arange(len(index))[:, None], index] - joints
    product = (moved[..., : joints.shape[-1]] * wanted[:, :, :-1]).mean(axis=2)
    return np.concatenate([moved.mean(axis=2), moved.var(axis=2), product], axis=-1)


def weights(prior: Trajectories) -> np.ndarray:
    """(O,) W of equation 8: one over how far simulations from the prior lie off, so that units cancel."""
    mean = prior.square[prior.valid].mean(axis=0) if prior.valid.any() else np.zeros(prior.square.shape[1])
    return np.where(mean > 0, 1 / np.sqrt(np.where(mean > 0, mean, 1.0)), 0.0)


def distance(seen: Trajectories, weights: np.ndarray, l1: float, l2: float) -> np.ndarray:
    """(M,) equation 8 as a mean over time and observations; infinite where the simulation diverged.

    Args:
      seen: simulations of M particles.
      weights: (O,) W.
      l1: of the one-norm.
      l2: of the squared two-norm.
    """
    with np.errstate(invalid="ignore"):
        value = l1 * (seen.absolute * weights).mean(axis=1) + l2 * (seen.square * weights**2).mean(axis=1)
    return np.where(seen.valid & np.isfinite(value), value, np.inf)
