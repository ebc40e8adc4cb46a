"""What a generation of TCBI costs beside bare stepping of the same physics, and how that grows with the particles.

./tcbi python bench/inference.py            # seven pairs, 1000 particles, the memory of 30 s of walking: long
./tcbi python bench/inference.py --quick    # three pairs, no more than 100 particles
"""

import argparse
import functools
import json
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from engine import seconds
from scale import problem

from tcbi_bringup.commands.bench import figure
from tcbi_infer.tcbi import problem as simulating
from tcbi_infer.tcbi.driver import settings_of
from tcbi_infer.tcbi.features import Features
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import LONGEST_STEP, Problem
from tcbi_sim.engine import Simulator
from tcbi_sim.model import base_model

STEP_S, SETTLE_S = LONGEST_STEP, 1.0
ROLLOUTS, DURATION_S, PARTICLES = 20, 4.0, 50  # a generation of 1000 rollouts
BEFORE = 5  # generations before the timed one: the default's last, in which the most particles are weighed
LOOPS = {"open loop": "gait:steps", "closed loop": "forward"}  # who moves the robot
FEW_ROLLOUTS, COUNTS = 2, (10, 100, 1000)  # of the growth with the particles
LONG_S, MANY, SOME = 30.0, 1000, 40  # walking as in the paper; so many particles show what all of them would need


def generation(problem: Problem, particles: int) -> Callable[[], Any]:
    """The sixth generation of the default method, as `infer` runs it: simulations, statistics, divergences, weights.

    What it simulates with short time steps, once before the last one, is not in it.
    """
    method = find_method("calibrated")
    settings = settings_of(method, {"particles": particles, "generations": BEFORE + 1})
    real = method.observe(problem)
    state = method.init(np.random.default_rng(1), len(problem.model.names), real, settings)

    def step() -> Any:
        rng = np.random.default_rng([1, state.generation])
        return method.step(rng, state, lambda cube: problem.simulate(cube, None, method.view), real, settings)

    for _ in range(BEFORE):
        state, _ = step()
    return step


def bare(problem: Problem, particles: int) -> Callable[[], None]:
    """MuJoCo's batched stepping alone, of as many rollouts of the same model from the same postures."""
    (group,) = problem.groups
    rng, rollouts = np.random.default_rng(2), len(group.measurements)
    values = np.repeat(problem.model.sample(rng, particles), rollouts, axis=0)
    simulator = Simulator(problem.model, values, [m.scenario for m in group.measurements] * particles, STEP_S)
    batch, steps = simulator._batch, round(DURATION_S / STEP_S)
    for i in range(len(group.measurements[0].commands.time)):
        time = float(group.measurements[0].commands.time[i])
        simulator.path.give(time, np.stack([m.commands.target[i] for m in group.measurements] * particles), 0.2)
    control = np.zeros((len(values), steps, simulator.mj.nu))
    control[:, :, simulator._actuators] = simulator.path.references((np.arange(steps) + 0.5) * STEP_S, STEP_S)
    start, everyone = batch.state.copy(), np.arange(len(values))

    def stepping() -> None:
        batch.state[...] = start
        batch.step(everyone, round(SETTLE_S / STEP_S))
        batch.rollout(steps, control, record=("sensordata",))

    return stepping


@contextmanager
def stopwatch() -> Iterator[list[float]]:
    """Seconds that inferences spend in the engine meanwhile, call by call."""
    spent: list[float] = []
    original = simulating.simulate

    def timed(*args: Any, **options: Any) -> Any:
        found: list[Any] = []
        spent.append(seconds(lambda: found.append(original(*args, **options))))
        return found[0]

    simulating.simulate = timed
    try:
        yield spent
    finally:
        simulating.simulate = original


def beside_stepping(loop: str, pairs: int) -> list[dict[str, Any]]:
    """A generation of 1000 rollouts to the bare stepping, and what of it is not simulation."""
    of_all = problem(base_model("hexapod"), ROLLOUTS, DURATION_S, LOOPS[loop], STEP_S)
    whole, stepping = generation(of_all, PARTICLES), bare(of_all, PARTICLES)
    whole()
    ratios, shares = [], []
    for _ in range(pairs):
        with stopwatch() as simulated:
            took = seconds(whole)
        ratios.append(took / seconds(stepping))
        shares.append(1.0 - sum(simulated) / took)
    ratio = f"{loop}: sixth generation of 1000 rollouts to bare batched stepping, median"
    rest = f"{loop}: statistics, divergences and weights, share of that generation, median"
    return [
        figure(ratio, statistics.median(ratios), "1", most=1.05),
        figure(rest, statistics.median(shares), "1", most=0.02),
    ]


def growth(counts: tuple[int, ...], pairs: int) -> list[dict[str, Any]]:
    """Time of each particle beside that of a particle in the middle one of these counts."""
    few = problem(base_model("hexapod"), FEW_ROLLOUTS, DURATION_S, step=STEP_S)
    works = {n: generation(few, n) for n in counts}
    base, others = counts[1], [n for n in counts if n != counts[1]]
    works[base]()
    ratios: dict[int, list[float]] = {n: [] for n in others}
    for _ in range(pairs):
        each = seconds(works[base]) / base
        for n in others:
            ratios[n].append(seconds(works[n]) / n / each)
    return [
        figure(f"time of a particle, {n} to {base} of them, median", statistics.median(found), "1", most=1.1)
        for n, found in ratios.items()
    ]


def memory() -> list[dict[str, Any]]:
    """Peak of a process that simulates some particles, and joins and weighs as many as six generations have."""
    done = subprocess.run([sys.executable, __file__, "--memory"], stdout=subprocess.PIPE, text=True, check=True)
    peak, kept = json.loads(done.stdout)
    name = f"memory at {MANY} particles x {ROLLOUTS} rollouts x {LONG_S:g} s"
    return [
        figure(f"{name}: peak over {BEFORE + 1} generations, without the check in time", peak, "MiB", most=2048),
        figure("what a particle keeps", 1024 * kept, "KiB"),
    ]


def _memory() -> tuple[float, float]:
    """MiB: the peak, and what a particle keeps.

    Simulations come in chunks, so that some particles take as much as all do; what they keep is then repeated.
    """
    walking = problem(base_model("hexapod"), ROLLOUTS, LONG_S, step=STEP_S)
    method = find_method("calibrated")
    settings = settings_of(method, {"particles": MANY, "generations": BEFORE + 1})
    real, names = method.observe(walking), walking.model.names
    some = walking.simulate(np.random.default_rng(0).random((SOME, len(names))), None, method.view)
    kept = sum(v.nbytes for v in (*some, *some.differences) if isinstance(v, np.ndarray)) / SOME
    state = method.init(np.random.default_rng(1), len(names), real, settings)
    for generation in range(BEFORE + 1):
        rng = np.random.default_rng([1, generation])
        state, _ = method.step(
            rng, state, lambda cube: functools.reduce(Features.join, [some] * (MANY // SOME)), real, settings
        )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, kept / 2**20


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three pairs, no more than 100 particles, no memory")
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        print(json.dumps(_memory()))
        return 0
    pairs = 3 if options.quick else 7
    figures = [row for loop in LOOPS for row in beside_stepping(loop, pairs)]
    figures += growth(COUNTS[:2] if options.quick else COUNTS, 3)
    print(json.dumps({"name": "inference", "figures": figures + ([] if options.quick else memory())}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
