"""What servos of one make leave of divergences, because each has its own gain: natural, and no reason to doubt a model.

It does not shrink as rollouts grow, as what rollouts differ by does. So with many of them every robot would be called
wrong for it.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from tcbi_infer.tcbi.calibration import LEAST
from tcbi_infer.tcbi.problem import Problem, View, histogram_features
from tcbi_sim.scatter import SCATTER, with_scatter

SETS = 12  # of servos, with the parameters that fit best
LEAST_SETS = 6  # of which less is no measure


class Scattered(NamedTuple):
    """Mean divergence that such servos leave, over what rollouts differ by."""

    statistics: np.ndarray  # (statistics,) mean over channels
    channels: dict[str, float]
    particles: int  # simulated for it


def simulate_with(problem: Problem, unit: np.ndarray, scales: np.ndarray, view: View) -> Any:
    """What a view keeps of (N, P) particles of the parameters' unit cube, with (N, servos) gains over the model's."""
    model, _ = with_scatter(problem.model)
    added = model.parameters[unit.shape[1] :]
    own = [p.to_unit(scale) for p, scale in zip(added, scales.T, strict=True)]
    return dataclasses.replace(problem, model=model, prior=None).simulate(np.column_stack([unit, *own]), view=view)


def draw_scales(problem: Problem, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, servos) of which the gains of servos of one make are times their siblings'."""
    return rng.normal(1.0, SCATTER, (count, len(with_scatter(problem.model)[1])))


def scattered(problem: Problem, best: np.ndarray) -> Scattered:
    """What their servos leave of robots that have otherwise (P,) parameters; nothing where that cannot be told."""
    scales = draw_scales(problem, SETS, np.random.default_rng(problem.seed))
    nothing = Scattered(np.zeros(len(problem.observed.statistics)), {}, 0)
    if not scales.size:
        return nothing
    unit = np.tile(best, (SETS + 1, 1))
    features = simulate_with(problem, unit, np.r_[np.ones((1, scales.shape[1])), scales], histogram_features)
    observed, counts, ended = problem.observed, features.counts, features.valid
    if not ended[0] or ended[1:].sum() < LEAST_SETS:
        return nothing._replace(particles=len(unit))
    left = observed.measure(counts[0].sum(axis=0), counts[1:][ended[1:]].sum(axis=1)).mean(axis=0)
    noise, _ = observed.measure.noise(observed.counts, counts[0])
    in_time = np.ones(len(observed.in_time.variance))  # whose noise is all that is left
    left, noise = np.r_[left, 0 * in_time], np.maximum(np.r_[noise, in_time], LEAST)
    of_statistic = observed.by_statistic(noise)
    channels = left / np.maximum(noise, of_statistic[observed.statistic])
    each = dict(zip(observed.channels, channels.tolist(), strict=True))
    return Scattered(observed.by_statistic(left) / of_statistic, each, len(unit))
