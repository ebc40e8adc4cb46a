"""pyABC and sbi at the inference that TCBI does, each in its own way: what it believes, and after how many seconds.

All have two processors. Both get this project's simulator, with all recorded rollouts of one robot in a call: pyABC
calls it for one particle at a time, in two processes that seed themselves (no two runs are alike), and compares
trajectories by a norm that adapts to them; sbi draws simulations for rounds of neural posterior estimation (NPE, its
sequential form) and learns from BayesSim's summary of the rollouts.
"""

import contextlib
import dataclasses
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_infer.baselines.trajectory import observe, trajectories
from tcbi_infer.statistics import RolloutArrays
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.problem import Problem, Simulated

POPULATION = 50  # of pyABC, and particles of TCBI
ROUND = 100  # simulations of a round of sbi
PROCESSES = 2


class Belief(NamedTuple):
    """What a method believes at one moment."""

    wall_s: float  # since it began
    simulations: int  # of one robot with all rollouts
    mean: np.ndarray  # (P,) of the parameters, in shares of the prior's range
    sd: np.ndarray  # (P,)


def with_tcbi(problem: Problem, seed: int, generations: int) -> list[Belief]:
    """After each generation of the default method; the last one's time and simulations count its check in time, too."""
    began, spent, beliefs = time.perf_counter(), 0.0, []
    problem = dataclasses.replace(problem, threads=PROCESSES)
    result = infer(problem, seed=seed, particles=POPULATION, generations=generations)
    for entry in result.generations:
        spent += entry["wall_s"]
        sd = np.sqrt(np.array(entry["variance_ratio"]) / 12)
        beliefs.append(Belief(spent, POPULATION * entry["generation"], np.array(entry["unit_mean"]), sd))
    simulations = result.simulations // len(problem.rollout_ids)
    beliefs[-1] = beliefs[-1]._replace(wall_s=time.perf_counter() - began, simulations=simulations)
    return beliefs


def with_pyabc(problem: Problem, seed: int, budget_s: float) -> list[Belief]:
    """After each population of sequential ABC."""
    import pyabc

    logging.getLogger("ABC").setLevel(logging.ERROR)
    np.random.seed(seed)  # what pyABC draws from outside its processes
    problem = dataclasses.replace(problem, threads=1)
    names = problem.model.names

    def model(parameters: Any) -> dict[str, np.ndarray]:
        seen = problem.simulate(np.array([[parameters[name] for name in names]]), None, states)
        return {"state": seen.values[0] if seen.valid[0] else np.full(seen.values.shape[1], 1e3)}

    prior = pyabc.Distribution(**{name: pyabc.RV("uniform", 0, 1) for name in names})
    sampler = pyabc.MulticoreEvalParallelSampler(n_procs=PROCESSES)
    search = pyabc.ABCSMC(model, prior, pyabc.AdaptivePNormDistance(p=2), POPULATION, sampler=sampler)
    measured = [group.arrays for group in problem.groups]
    seen = states(problem, Simulated(measured, measured, np.ones(1, bool))).values[0]
    beliefs: list[Belief] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        search.new(f"sqlite:///{Path(folder) / 'abc.db'}", {"state": np.nan_to_num(seen)})
        began = time.perf_counter()
        while (left := budget_s - (time.perf_counter() - began)) > 0:
            before = search.history.max_t
            history = search.run(max_nr_populations=1, max_walltime=timedelta(seconds=left))
            if history.max_t == before:
                break
            found, weights = history.get_distribution(t=history.max_t)
            beliefs.append(_belief(began, history.total_nr_simulations, found[list(names)].to_numpy(), weights))
    return beliefs


def with_sbi(problem: Problem, seed: int, budget_s: float) -> list[Belief]:
    """After each round of sequential neural posterior estimation."""
    with tempfile.TemporaryDirectory() as folder:
        return _rounds(problem, seed, budget_s, folder)


def _rounds(problem: Problem, seed: int, budget_s: float, folder: str) -> list[Belief]:
    import torch
    from sbi.inference import NPE, simulate_for_sbi
    from sbi.utils import BoxUniform
    from torch.utils.tensorboard import SummaryWriter

    warnings.filterwarnings("ignore", module="sbi")
    torch.manual_seed(seed)
    problem = dataclasses.replace(problem, threads=1)
    width = len(problem.model.names)
    prior = BoxUniform(torch.zeros(width), torch.ones(width))
    writer = SummaryWriter(folder)  # sbi's own would lie in the folder that it is called from
    estimator = NPE(prior=prior, density_estimator="maf", show_progress_bars=False, summary_writer=writer)
    real = torch.as_tensor(observe(problem).summary, dtype=torch.float32)
    proposal: Any = prior
    beliefs: list[Belief] = []
    began, done = time.perf_counter(), 0
    while time.perf_counter() - began < budget_s:
        with contextlib.redirect_stdout(sys.stderr):
            parameters, seen = simulate_for_sbi(
                _Summaries(problem), proposal, ROUND, num_workers=PROCESSES, seed=seed + done, show_progress_bar=False
            )
            estimator.append_simulations(parameters, seen, proposal=proposal if done else None).train()
            proposal = estimator.build_posterior().set_default_x(real)
            draws = proposal.sample((1000,), show_progress_bars=False).numpy()
        done += ROUND
        beliefs.append(_belief(began, done, draws, np.full(len(draws), 1 / len(draws))))
    writer.close()
    return beliefs


PEERS: dict[str, Callable[[Problem, int, float], list[Belief]]] = {"pyabc": with_pyabc, "sbi": with_sbi}


def _belief(began: float, simulations: int, draws: np.ndarray, weights: np.ndarray) -> Belief:
    mean = weights @ draws
    return Belief(time.perf_counter() - began, simulations, mean, np.sqrt(weights @ (draws - mean) ** 2))


@dataclasses.dataclass(frozen=True)
class _Summaries:
    """sbi's simulator: parameters of one robot -> BayesSim's summary of its rollouts."""

    problem: Problem

    def __call__(self, parameters: Any) -> Any:
        import torch

        cube = np.atleast_2d(np.asarray(parameters, dtype=float))
        seen = self.problem.simulate(cube, None, trajectories)
        return torch.as_tensor(np.where(seen.valid[:, None], seen.summary, np.nan), dtype=torch.float32)


class States(NamedTuple):
    """Joint angles, roll and pitch of all rollouts at the control ticks."""

    values: np.ndarray  # (M, K) rad; where the recorded rollouts lack a sample, 0
    valid: np.ndarray  # (M,) bool

    def join(self, other: "States") -> "States":
        """Both sets of particles, these first."""
        return States(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def states(problem: Problem, simulated: Simulated) -> States:
    """The view of `Problem.simulate` for pyABC."""
    period = max(1, round(CONTROL_PERIOD_S * problem.rate))
    parts = [part[:, :, ::period] for arrays in simulated.readings for part in _measured(arrays)]
    values = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    return States(np.nan_to_num(values), simulated.valid)


def _measured(arrays: RolloutArrays) -> Iterator[np.ndarray]:
    yield arrays.joint_position
    if arrays.attitude is not None:
        yield arrays.roll_pitch
