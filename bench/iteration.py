"""Seconds per iteration of TCBI, ABC and SimOpt at the paper's budget, as in its Figure 11.

./tcbi python bench/iteration.py                    # both tasks as in the paper: half an hour
./tcbi python bench/iteration.py --task balance
./tcbi python bench/iteration.py --quick            # 4 rollouts of 4 s

An iteration is 50 particles in each of 20 rollouts, of 8 s (balance) or 30 s (forward), in closed loop. The methods
take turns, iteration by iteration, and the median over all but each one's first is told: as a whole, and what of it is
not simulation (statistics or trajectories, their comparison, the update). The paper's ratios stand beside the rivals'.
"""

import argparse
import dataclasses
import json
import statistics
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from engine import seconds
from inference import stopwatch

from tcbi_bringup.commands.bench import figure
from tcbi_infer.tcbi.driver import settings_of
from tcbi_infer.tcbi.loop import CLOSED
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import LONGEST_STEP, Problem
from tcbi_policy.artefact import find_policy
from tcbi_sim.engine import simulate
from tcbi_sim.model import base_model
from tcbi_sim.tasks import find_task

PARTICLES, ROLLOUTS = 50, 20  # Table 2
ITERATIONS = {"balance": 5, "forward": 3}  # of each method
METHODS = {"calibrated": "TCBI", "paper": "TCBI as published", "abc_smc": "ABC", "simopt": "SimOpt"}
PAPERS = {"balance": (2.5, 12.8, 28.5), "forward": (2.6, 36.2, 54.3)}  # s: TCBI, ABC, SimOpt in Figure 11
RIVALS = ("abc_smc", "simopt")
STEP_S = LONGEST_STEP


def problems(task: str, rollouts: int, duration: float) -> dict[str, Problem]:
    """Of each method, with its own statistics, from rollouts of the task's scenarios in closed loop of its policy."""
    model, actor, rng = base_model("hexapod"), find_policy(task), np.random.default_rng(0)
    scenarios = [dataclasses.replace(find_task(task).draw(rng, k), duration=duration) for k in range(rollouts)]
    out = simulate(model, model.mean()[None], scenarios, controller=actor, timestep=STEP_S)
    measured = [out.measurement(0, s, f"rollout_{s}", actor.policy_id) for s in range(rollouts)]
    statistics = {name: find_method(name).statistics for name in METHODS}
    return {
        name: Problem.of(model, measured, statistics=s, loop=CLOSED, timestep=STEP_S) for name, s in statistics.items()
    }


def iterating(of: Problem, name: str, particles: int) -> Callable[[], None]:
    """One iteration of a method after the other, each call the next."""
    method = find_method(name)
    settings = settings_of(method, {"particles": particles, "generations": max(ITERATIONS.values()) + 1})
    real = method.observe(of)
    state = method.init(np.random.default_rng(1), len(of.model.names), real, settings)

    def iterate() -> None:
        nonlocal state
        rng = np.random.default_rng([1, state.generation])
        state, _ = method.step(rng, state, lambda cube: of.simulate(cube, None, method.view), real, settings)

    return iterate


def figures(task: str, rollouts: int, duration: float, iterations: int) -> list[dict[str, Any]]:
    """Of one task: each method's seconds, and the rivals' over TCBI's."""
    works = {name: iterating(of, name, PARTICLES) for name, of in problems(task, rollouts, duration).items()}
    whole: dict[str, list[float]] = {name: [] for name in METHODS}
    rest: dict[str, list[float]] = {name: [] for name in METHODS}
    for k in range(iterations):
        for name, work in works.items():
            with stopwatch() as simulated:
                took = seconds(work)
            if k:
                whole[name].append(took)
                rest[name].append(took - sum(simulated))
            print(f"{task}, {METHODS[name]}, iteration {k + 1}: {took:.1f} s", file=sys.stderr, flush=True)
    rows = []
    for name, label in METHODS.items():
        rows.append(figure(f"{task}: {label}, an iteration, median", statistics.median(whole[name]), "s"))
        rows.append(figure(f"{task}: {label}, of it beside simulation, median", statistics.median(rest[name]), "s"))
    tcbi, *others = PAPERS[task]
    for name, theirs in zip(RIVALS, others, strict=True):
        for what, of_each in (("an iteration", whole), ("beside simulation", rest)):
            ratios = [a / b for a, b in zip(of_each[name], of_each["calibrated"], strict=True)]
            words = f"{task}: {METHODS[name]} to TCBI, {what}, median (Figure 11 has {theirs / tcbi:.1f})"
            rows.append(figure(words, statistics.median(ratios), "1"))
    return rows


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 rollouts of 4 s, two iterations")
    parser.add_argument("--task", choices=PAPERS, help="this one alone")
    options = parser.parse_args()
    rows = []
    for task in (options.task,) if options.task else PAPERS:
        whole = (ROLLOUTS, find_task(task).duration, ITERATIONS[task])
        rows += figures(task, *((4, 4.0, 2) if options.quick else whole))
    print(json.dumps({"name": "iteration", "figures": rows}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
