"""Every method of inference behind one adapter, by name.

A method is a state (a NamedTuple of arrays), an `init`, and a pure `step(rng, state, simulate, real, settings) ->
(state, info)`; the driver loops, saves and reports. A further method is one more module and one more entry in
`METHODS`. Its `view` says what it sees of simulated rollouts: task-level histograms, or trajectories.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tcbi_infer.baselines import abc_smc, bayesopt, budget, npe, prior, rejection, simopt, trajectory
from tcbi_infer.baselines.trajectory import Trajectories
from tcbi_infer.statistics import CALIBRATED, PAPER
from tcbi_infer.tcbi import calibrated, paper
from tcbi_infer.tcbi.features import Features, Observed
from tcbi_infer.tcbi.loop import ACTING, AUTO
from tcbi_infer.tcbi.problem import Problem, View, histogram_features, task_features
from tcbi_infer.tcbi.weights import effective_sample_size, normalised
from tcbi_sim.errors import UnknownNameError

Simulate = Callable[[np.ndarray], Any]  # (N, P) in [0, 1] -> what the method's view keeps
State = Any  # a NamedTuple


class Generation(NamedTuple):
    """What every method reports of a generation."""

    ess: float
    alpha: float
    divergence: np.ndarray  # (statistics,) weighted mean over particles
    notes: dict[str, Any]  # what the method adds; `best`, the particles that fit best, in the cube that it works on


def nothing() -> None:
    """The check of a method that needs no extra."""


@dataclass(frozen=True)
class Method:
    """A way from rollouts to weighted particles."""

    name: str
    summary: str
    statistics: tuple[str, ...]  # of the task, by default; a trajectory-based method looks at none of them
    settings: Any  # a NamedTuple class with `particles` and `generations` among its fields
    state_type: type
    init: Callable[[np.random.Generator, int, Any, Any], State]  # rng, dimensions, real rollouts, settings
    step: Callable[[np.random.Generator, State, Simulate, Any, Any], tuple[State, Generation]]
    finished: Callable[[State, Any], bool]
    posterior: Callable[[State, Any], tuple[np.ndarray, np.ndarray]]  # (M, P) in [0, 1], (M,) log-weights
    simulations: Callable[[State, Any], int]  # particles simulated so far
    view: View = task_features
    observe: Callable[[Problem], Any] = lambda problem: problem.observed  # the real rollouts, as the view sees them
    labels: Callable[[Problem], tuple[str, ...]] = lambda problem: problem.observed.statistics  # of `divergence`
    caveat: str = ""  # what a reader of its posterior must know
    distrusted: Callable[[State, float], np.ndarray] | None = None  # log-weights where the model misses by so much
    # after a step: what short time steps change, as `step`; None of a generation that stays as it is
    finely: Callable[[np.random.Generator, State, Simulate, Any, Any], tuple[State, Generation | None]] | None = None
    judges: bool = False  # whether its width says what the data tell, so that parameters can be called identified
    any_divergence: bool = False  # whether it looks at divergences at all
    by_task: bool = True  # whether it looks at the task's statistics, and not at trajectories
    loop: str = AUTO  # by default: who acts in its simulations
    check: Callable[[], None] = nothing  # raises where something is not installed


def _until_converged(state: State, settings: Any) -> bool:
    return bool(state.converged) or state.generation >= settings.generations


def _each_generation(state: State, settings: Any) -> int:
    return state.generation * settings.particles


def _paper_step(
    rng: np.random.Generator, state: Any, simulate: Callable[[np.ndarray], Features], observed: Observed, settings: Any
) -> tuple[paper.PaperState, Generation]:
    state, info = paper.step(rng, state, simulate, observed, settings)
    return state, Generation(info.ess, info.alpha, info.divergence, {"resampled": info.resampled})


def _calibrated_step(
    rng: np.random.Generator, state: Any, simulate: Callable[[np.ndarray], Features], observed: Observed, settings: Any
) -> tuple[calibrated.CalibratedState, Generation]:
    state, info = calibrated.step(rng, state, simulate, observed, settings)
    return state, _as_generation(info, observed)


def _calibrated_finely(
    rng: np.random.Generator, state: Any, simulate: Callable[[np.ndarray], Features], observed: Observed, settings: Any
) -> tuple[calibrated.CalibratedState, Generation | None]:
    state, info = calibrated.finely(rng, state, simulate, observed, settings)
    return state, None if info is None else _as_generation(info, observed)


def _as_generation(info: calibrated.CalibratedInfo, observed: Observed) -> Generation:
    notes = {
        "alpha_supported": info.alpha_supported,
        "floor_noise": info.floor_noise.tolist(),
        "floor_misfit": info.floor_misfit.tolist(),
        "misfit": dict(zip(observed.channels, info.misfit.tolist(), strict=True)),
        "best": info.best.tolist(),
    }
    return Generation(info.ess, info.alpha, info.divergence, notes)


def _baseline(
    name: str,
    summary: str,
    settings: Any,
    state_type: type,
    begin: Callable[[int, Trajectories], State],
    step: Callable[[np.random.Generator, State, Simulate, Any], State],
    posterior: Callable[[State, Any], tuple[np.ndarray, np.ndarray]],
    distance: Callable[[State, np.ndarray], float],
    caveat: str,
    check: Callable[[], None] = nothing,
) -> Method:
    """A trajectory-based method.

    Args:
      distance: state, (M,) weights of the posterior's particles -> mean distance of their trajectories, NaN if unknown.
    """

    def stepped(
        rng: np.random.Generator, state: State, simulate: Simulate, real: Any, given: Any
    ) -> tuple[State, Generation]:
        state = step(rng, state, simulate, given)
        weights = normalised(posterior(state, given)[1])
        return state, Generation(effective_sample_size(weights), np.nan, np.array([distance(state, weights)]), {})

    return Method(
        name, summary, CALIBRATED, settings, state_type,
        lambda rng, dimensions, real, given: begin(dimensions, real), stepped,
        _until_converged, posterior, _each_generation, trajectory.trajectories, trajectory.observe,
        lambda problem: (trajectory.STATISTIC,), caveat, by_task=False, check=check,
    )  # fmt: skip


_ALL = (
    Method(
        name="calibrated",
        summary="TCBI with weights corrected for the proposal and alpha set from the data (default)",
        statistics=CALIBRATED,
        settings=calibrated.CalibratedSettings,
        state_type=calibrated.CalibratedState,
        init=lambda rng, dimensions, real, settings: calibrated.init(dimensions),
        step=_calibrated_step,
        finished=calibrated.finished,
        posterior=lambda state, settings: calibrated.posterior(state),
        simulations=lambda state, settings: len(state.z) + state.correction.particles,
        view=histogram_features,
        finely=_calibrated_finely,
        distrusted=calibrated.distrusted,
        judges=True,
        any_divergence=True,
    ),
    Method(
        name="paper",
        summary="TCBI by Algorithm 1 as published",
        statistics=PAPER,
        settings=paper.PaperSettings,
        state_type=paper.PaperState,
        init=lambda rng, dimensions, real, settings: paper.init(rng, dimensions, settings),
        step=_paper_step,
        finished=paper.finished,
        posterior=lambda state, settings: paper.posterior(state),
        simulations=_each_generation,
        caveat="the paper's method narrows with every generation: judge it by error and coverage, not by its width",
        any_divergence=True,
        loop=ACTING,
    ),
    Method(
        name="prior",
        summary="fixed domain randomisation: the prior, whatever the rollouts say",
        statistics=CALIBRATED,
        settings=prior.PriorSettings,
        state_type=prior.PriorState,
        init=lambda rng, dimensions, real, settings: prior.init(rng, dimensions, settings),
        step=lambda rng, state, simulate, real, settings: (
            prior.step(state),
            Generation(float(len(state.z)), np.nan, np.array([np.nan]), {}),
        ),
        finished=_until_converged,
        posterior=lambda state, settings: prior.posterior(state),
        simulations=lambda state, settings: 0,
        view=trajectory.trajectories,
        observe=lambda problem: None,
        labels=lambda problem: (trajectory.STATISTIC,),
        caveat="fixed domain randomisation learns nothing from the rollouts",
        by_task=False,
    ),
    _baseline(
        "rejection",
        "rejection ABC on trajectories",
        rejection.RejectionSettings,
        budget.Searched,
        budget.begin,
        rejection.step,
        rejection.posterior,
        budget.mean_distance,
        "rejection ABC is as wide as its tolerance, which the budget sets and not the data",
    ),
    _baseline(
        "abc_smc",
        "sequential ABC on trajectories",
        abc_smc.AbcSmcSettings,
        abc_smc.AbcSmcState,
        abc_smc.begin,
        abc_smc.step,
        lambda state, settings: abc_smc.posterior(state),
        abc_smc.mean_distance,
        "sequential ABC narrows while its tolerance falls: its width is the budget's, not what the data leave open",
    ),
    _baseline(
        "simopt",
        "SimOpt: a Gaussian moved by relative entropy policy search on trajectories",
        simopt.SimOptSettings,
        simopt.SimOptState,
        simopt.begin,
        simopt.step,
        lambda state, settings: simopt.posterior(state),
        lambda state, weights: state.discrepancy,
        "SimOpt is an optimiser: its width says where it still looks, not what the data leave open",
    ),
    _baseline(
        "bayesopt",
        "Bayesian optimisation on trajectories, by optuna (an optional extra)",
        bayesopt.BayesOptSettings,
        budget.Searched,
        budget.begin,
        bayesopt.step,
        lambda state, settings: bayesopt.posterior(state),
        budget.mean_distance,
        "Bayesian optimisation gives one point and no posterior: its intervals mean nothing",
        bayesopt.check,
    ),
    _baseline(
        "npe",
        "neural posterior estimation as in BayesSim",
        npe.NpeSettings,
        npe.NpeState,
        npe.init,
        npe.step,
        lambda state, settings: npe.posterior(state),
        lambda state, weights: np.nan,
        "a neural posterior is as good as its network: few simulations, or recordings unlike all of them, mislead it",
    ),
)
METHODS = {method.name: method for method in _ALL}


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
      UnknownNameError: there is none.
      MissingExtraError: what it needs is not installed.
    """
    if name not in METHODS:
        raise UnknownNameError("method", name, tuple(METHODS))
    METHODS[name].check()
    return METHODS[name]
