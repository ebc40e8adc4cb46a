"""Bayesian optimisation by optuna: the parameters whose trajectories lie nearest to the recorded ones.

A tree-structured Parzen estimator over all parameters together, asked for a generation at a time (each particle still
at work counts as a bad one, so that a batch spreads). The outcome is a point. optuna is an optional extra.
"""

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from tcbi_infer.baselines.budget import Searched, equally, euclidean, extended
from tcbi_infer.baselines.trajectory import Trajectories
from tcbi_infer.errors import MissingExtraError
from tcbi_infer.tcbi.proposal import EDGE, to_probit


class BayesOptSettings(NamedTuple):
    """Budget."""

    particles: int = 50  # simulated in each generation
    generations: int = 6


def check() -> None:
    """Whether optuna is there.

    Raises:
      MissingExtraError: it is not.
    """
    _optuna()


def _optuna() -> ModuleType:
    try:
        return importlib.import_module("optuna")
    except ImportError as e:
        raise MissingExtraError("bayesopt", "optuna") from e


def step(
    rng: np.random.Generator,
    state: Searched,
    simulate: Callable[[np.ndarray], Trajectories],
    settings: BayesOptSettings,
) -> Searched:
    """Ask for a generation, simulate it."""
    unit = _asked(rng, state, settings.particles)
    return extended(state, to_probit(unit), simulate(unit))


def _asked(rng: np.random.Generator, state: Searched, count: int) -> np.ndarray:
    """(count, P) in [0, 1] that optuna proposes after what was simulated so far."""
    optuna = _optuna()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(
        multivariate=True,
        constant_liar=True,
        n_startup_trials=count,
        seed=int(rng.integers(2**31)),
    )
    study = optuna.create_study(sampler=sampler)
    names = [f"x{i}" for i in range(state.z.shape[1])]
    ranges: dict[str, Any] = {name: optuna.distributions.FloatDistribution(EDGE, 1 - EDGE) for name in names}
    cost = euclidean(state)
    worst = cost[np.isfinite(cost)].max() if np.isfinite(cost).any() else 1.0
    for unit, value in zip(equally(state.z, np.ones(len(state.z), bool))[0], cost, strict=True):
        params = dict(zip(names, unit.tolist(), strict=True))
        value = float(value) if np.isfinite(value) else 2 * float(worst)
        study.add_trial(optuna.trial.create_trial(params=params, distributions=ranges, value=value))
    trials = [study.ask(ranges) for _ in range(count)]
    return np.array([[trial.params[name] for name in names] for trial in trials])


def posterior(state: Searched) -> tuple[np.ndarray, np.ndarray]:
    """(M, P) particles in [0, 1] and (M,) log-weights: all weight on the best."""
    return equally(state.z, np.arange(len(state.z)) == int(np.argmin(euclidean(state))))
