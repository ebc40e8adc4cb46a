"""Does the robot move as any of the posterior's draws does? What histograms cannot see: the order of events in time.

A servo that answers late, or slowly because its torque is limited, leaves nearly the histogram of a softer one. So the
recorded commands are replayed with draws of the posterior, and joints and attitude are followed through time. If the
robot were one more draw, the nearest prediction would lie about as far from it as from the other draws. This is a
posterior predictive check (Gelman, Meng and Stern 1996) by nearest neighbours: a wide posterior does not hide a shape
that none of its draws has.
"""

import numpy as np

from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.weights import normalised, resample

DRAWS = 48  # of the posterior: about a generation's simulations
LEAST_DRAWS = 8  # different ones, of which less is no measure of how far apart they lie


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
    drawn = np.unique(resample(np.random.default_rng(problem.seed), normalised(log_weights), DRAWS))
    groups, valid = problem.open_loop.rollouts(unit[drawn])
    if valid.sum() < LEAST_DRAWS:
        return {}
    pairs = [(group.arrays, simulated) for group, simulated in zip(problem.groups, groups, strict=True)]
    signals = {"joint positions": [(real.joint_position, some.joint_position) for real, some in pairs]}
    if all(real.attitude is not None for real, _ in pairs):
        signals["roll and pitch"] = [(real.roll_pitch, some.roll_pitch) for real, some in pairs]
    return {name: _departure([(real, some[valid]) for real, some in both]) for name, both in signals.items()}


def _departure(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Of (1, S, T, C) measured and (N, S, T, C) simulated signals of each group; 1 where nothing was measured."""
    draws = len(pairs[0][1])
    squares = np.zeros((draws + 1, draws + 1))  # of the distances between draws, the robot being the last of them
    for real, simulated in pairs:
        everyone = np.concatenate([simulated, real])
        known = np.isfinite(everyone).all(axis=0)
        flat = everyone[:, known] - real[:, known]  # small numbers, whose squares keep their digits
        own = (flat**2).sum(axis=1)
        squares += own[:, None] + own - 2 * flat @ flat.T
    np.fill_diagonal(squares, np.inf)
    nearest = np.sqrt(np.maximum(squares[:, :draws].min(axis=1), 0.0))
    among = float(np.median(nearest[:draws]))
    return float(nearest[draws] / among) if among > 0 else 1.0
