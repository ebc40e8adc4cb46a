"""Every method of inference behind one adapter, by name.

A method is a state (a NamedTuple of arrays), an `init`, and a pure `step(rng, state, simulate) -> (state, info)`; the
driver loops, saves and reports. A further method is one more module and one more entry in `METHODS`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tcbi_infer.errors import InferError
from tcbi_infer.statistics import CALIBRATED, PAPER
from tcbi_infer.tcbi import calibrated, paper
from tcbi_infer.tcbi.features import Features, Observed

Simulate = Callable[[np.ndarray], Features]  # (N, P) in [0, 1] -> features
State = Any  # a NamedTuple


class Generation(NamedTuple):
    """What every method reports of a generation."""

    ess: float
    alpha: float
    divergence: np.ndarray  # (statistics,) weighted mean over particles
    notes: dict[str, Any]  # what the method adds


@dataclass(frozen=True)
class Method:
    """A way from rollouts to weighted particles."""

    name: str
    summary: str
    statistics: tuple[str, ...]
    settings: Callable[..., Any]  # keyword arguments -> the method's settings
    state_type: type
    init: Callable[[np.random.Generator, int, Any], State]
    step: Callable[[np.random.Generator, State, Simulate, Observed, Any], tuple[State, Generation]]
    finished: Callable[[State, Any], bool]
    posterior: Callable[[State], tuple[np.ndarray, np.ndarray]]  # (M, P) in [0, 1], (M,) log-weights
    simulations: Callable[[State, Any], int]  # particles simulated so far


def _paper_step(
    rng: np.random.Generator,
    state: paper.PaperState,
    simulate: Simulate,
    observed: Observed,
    settings: paper.PaperSettings,
) -> tuple[paper.PaperState, Generation]:
    state, info = paper.step(rng, state, simulate, observed.by_statistic, settings)
    return state, Generation(info.ess, info.alpha, info.divergence, {"resampled": info.resampled})


def _calibrated_step(
    rng: np.random.Generator,
    state: calibrated.CalibratedState,
    simulate: Simulate,
    observed: Observed,
    settings: calibrated.CalibratedSettings,
) -> tuple[calibrated.CalibratedState, Generation]:
    state, info = calibrated.step(rng, state, simulate, observed, settings)
    notes = {
        "alpha_supported": info.alpha_supported,
        "floor_noise": info.floor_noise.tolist(),
        "floor_misfit": info.floor_misfit.tolist(),
        "best": info.best.tolist(),
    }
    return state, Generation(info.ess, info.alpha, info.divergence, notes)


METHODS = {
    "calibrated": Method(
        name="calibrated",
        summary="weights corrected for the proposal, alpha set from the data (default)",
        statistics=CALIBRATED,
        settings=calibrated.CalibratedSettings,
        state_type=calibrated.CalibratedState,
        init=lambda rng, dimensions, settings: calibrated.init(dimensions),
        step=_calibrated_step,
        finished=calibrated.finished,
        posterior=calibrated.posterior,
        simulations=lambda state, settings: len(state.z),
    ),
    "paper": Method(
        name="paper",
        summary="Algorithm 1 as published: narrows with every generation, whatever the data say",
        statistics=PAPER,
        settings=paper.PaperSettings,
        state_type=paper.PaperState,
        init=paper.init,
        step=_paper_step,
        finished=paper.finished,
        posterior=paper.posterior,
        simulations=lambda state, settings: state.generation * settings.particles,
    ),
}


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
      InferError: there is none.
    """
    if name not in METHODS:
        raise InferError(f"unknown method {name!r}; known are {', '.join(METHODS)}")
    return METHODS[name]
