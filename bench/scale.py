"""What simulating with Ray costs beside this process at the same work, what travels, and what the driver does itself.

./tcbi python bench/scale.py            # seven pairs; needs Ray, an optional extra (docs/scale.md)
./tcbi python bench/scale.py --quick    # three

Its figures are what bench/scale_model.py starts from, and one of them is how well that foretells two cores.
"""

import functools
import os
import pickle
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import psutil
from engine import main, seconds
from scale_model import Case, run

from tcbi_bringup.commands.bench import figure
from tcbi_infer.tcbi import calibrated
from tcbi_infer.tcbi.features import Features
from tcbi_infer.tcbi.loop import ACTING
from tcbi_infer.tcbi.problem import Problem, histogram_features, task_features
from tcbi_policy.artefact import find_policy
from tcbi_sim import ray_workers
from tcbi_sim.engine import Chunk, SimulatedRollouts, _simulated, simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import Model, base_model
from tcbi_sim.workers import Here, using

STEP_S, SETTLE_S = 0.01, 1.0
ROLLOUTS, DURATION_S, PARTICLES = 8, 4.0, 24  # of the pairs: 96,000 steps with those of settling
LONG_S, RECORDED = 30.0, 20  # of what travels: the walking task of the paper
EMPTY = 400  # tasks without work
TRAJECTORIES, FEATURES = "simulate, trajectories travel", "inference, histograms travel"


def problem(model: Model, rollouts: int, duration: float, policy: str = "gait:steps", step: float = STEP_S) -> Problem:
    """An inference from rollouts, each from its own posture: of a scripted gait, or in closed loop of a policy."""
    actor = find_policy(policy)
    scenarios = [Scenario("forward", duration, initial_yaw=0.1 * k, seed=k) for k in range(rollouts)]
    out = simulate(model, model.mean()[None], scenarios, controller=actor, timestep=step)
    measured = [out.measurement(0, s, f"rollout_{s}", actor.policy_id) for s in range(rollouts)]
    return Problem.of(model, measured, loop=ACTING, timestep=step)


def processor_seconds() -> float:
    """Of this process and all that it has started, so far."""
    me = psutil.Process()
    times = [p.cpu_times() for p in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def measure(pairs: int) -> list[dict[str, Any]]:
    """Figures; every ratio is the median over pairs of runs in turn."""
    model, rng = base_model("hexapod"), np.random.default_rng(0)
    values, small = model.sample(rng, PARTICLES), problem(model, ROLLOUTS, DURATION_S)
    unit = rng.random((PARTICLES, len(model.names)))
    scenarios = [m.scenario for g in small.groups for m in g.measurements]
    commands = [m.commands for g in small.groups for m in g.measurements]
    works: dict[str, Callable[[], Any]] = {
        TRAJECTORIES: lambda: simulate(model, values, scenarios, commands=commands, timestep=STEP_S),
        FEATURES: lambda: small.simulate(unit),
    }
    with ray_workers.cluster("") as them:
        figures = beside(works, them, pairs)
        costs = {**of_tasks(them), **of_steps(small), **of_weighing(problem(model, RECORDED, DURATION_S))}
        figures.append(figure("round trip of one task", 1e3 * round_trip(them), "1e-3 s"))
    sizes = what_travels(model)
    bytes_back = sizes["bytes back for each rollout of 30 s, trajectories"] * DURATION_S / LONG_S
    figures.append(figure(f"{TRAJECTORIES}: the same ratio, foretold", foretold(costs, bytes_back), "1"))
    figures += [figure(name, value, "bytes") for name, value in sizes.items()]
    return figures + [figure(f"cost {name}", value * scale, unit) for name, (value, scale, unit) in told(costs).items()]


def told(costs: dict[str, float]) -> dict[str, tuple[float, float, str]]:
    """Each cost with the unit in which it is read well."""
    units = {"take_s_per_byte": (1e9, "1e-9 s"), "weigh_s": (1.0, "s"), "weigh_power": (1.0, "1")}
    return {name: (value, *units.get(name, (1e6, "1e-6 s"))) for name, value in costs.items()}


def foretold(costs: dict[str, float], bytes_back: float) -> float:
    """Wall time with Ray to without, of trajectories on this machine, by bench/scale_model.py."""
    cores = len(os.sched_getaffinity(0))
    rollout_s = DURATION_S + SETTLE_S
    case = Case(
        **{**costs, "weigh_s": 0.0, "shared_bytes": 0.0},
        rollouts=PARTICLES * ROLLOUTS,
        per_particle=1,
        generations=1,
        rollout_s=rollout_s,
        timestep=STEP_S,
        finer=0,
        check=0,
        close=0,
        bytes_back=bytes_back,
        cores_each=cores,
        straggling=0.0,
        slow_share=0.0,
    )
    alone = costs["chunk_s"] + case.rollouts * rollout_s / STEP_S * costs["step_s"] / cores
    return run(case, cores).wall_s / alone


def beside(works: dict[str, Callable[[], Any]], them: ray_workers.RayWorkers, pairs: int) -> list[dict[str, Any]]:
    """Wall time and processor seconds of the same work with Ray and without."""
    figures = []
    for name, work in works.items():
        same(work, them)
        wall, busy = [], []
        for _ in range(pairs):
            begin = processor_seconds()
            here = seconds(work)
            middle = processor_seconds()
            with using(them):
                there = seconds(work)
            wall.append(there / here)
            busy.append((processor_seconds() - middle) / (middle - begin))
        figures += [
            figure(f"{name}: wall time with Ray to without, median", statistics.median(wall), "1", most=1.1),
            figure(f"{name}: processor seconds with Ray to without, median", statistics.median(busy), "1", most=1.1),
        ]
    return figures


def same(work: Callable[[], Any], them: ray_workers.RayWorkers) -> None:
    """Warm up both ways; what they give must be the same, else no ratio means anything."""
    here = work()
    with using(them):
        there = work()
    mine, other = (
        [v for v in (vars(x).values() if isinstance(x, SimulatedRollouts) else x) if isinstance(v, np.ndarray)]
        for x in (here, there)
    )
    assert mine and all(np.array_equal(a, b, equal_nan=a.dtype != bool) for a, b in zip(mine, other, strict=True))


def nothing(chunk: Any) -> Any:
    """A task without work."""
    return chunk


def blank(size: int) -> np.ndarray:
    """A result of so many bytes."""
    return np.zeros(size // 8)


def of_tasks(them: ray_workers.RayWorkers) -> dict[str, float]:
    """Seconds of the driver for each task, and for each byte that comes back."""
    them.map(nothing, list(range(50)))
    begin = time.process_time()
    them.map(nothing, list(range(EMPTY)))
    each = (time.process_time() - begin) / EMPTY
    size, count = 4 * 2**20, 10
    begin = time.process_time()
    them.map(blank, [size] * count)
    return {
        "hand_out_s": each / 2,
        "take_s": each / 2,
        "take_s_per_byte": max(0.0, (time.process_time() - begin) / count - each) / size,
    }


def round_trip(them: ray_workers.RayWorkers) -> float:
    """Seconds until one task without work is back, median."""
    return statistics.median(seconds(lambda: them.map(nothing, [0])) for _ in range(50))


def of_steps(small: Problem) -> dict[str, float]:
    """Seconds of one core for each step, histograms included, and for each chunk besides: one of a few steps."""
    still = Commands(np.zeros(1), np.zeros((1, 18)))
    short = Chunk(0, small.model.mean()[None], [Scenario("balance", 0.1, settle=0.0)], [still])
    unit = np.full((10, len(small.model.names)), 0.5)

    def spent(work: Callable[[], Any]) -> float:
        begin = time.process_time()
        work()
        return time.process_time() - begin

    with using(Here(threads=1)):
        each = statistics.median(
            spent(lambda: _simulated(small.model, None, None, STEP_S, 1, None, None, short)) for _ in range(9)
        )
        many = statistics.median(spent(lambda: small.seen(task_features, unit)) for _ in range(3))
    steps = len(unit) * ROLLOUTS * (DURATION_S + SETTLE_S) / STEP_S
    return {"step_s": (many - each) / steps, "chunk_s": each}


def of_weighing(small: Problem) -> dict[str, float]:
    """Seconds of the driver after a generation of a thousand particles, and the power with which they grow."""
    few = small.simulate(np.random.default_rng(1).random((20, len(small.model.names))), None, histogram_features)

    def weighing(count: int) -> float:
        many = functools.reduce(Features.join, [few] * (count // 20))
        state, settings = calibrated.init(len(small.model.names)), calibrated.CalibratedSettings(particles=count)
        rng, spent = np.random.default_rng(2), 0.0
        for _ in range(2):
            begin = time.process_time()
            state, _ = calibrated.step(rng, state, lambda unit: many, small.observed, settings)
            spent = time.process_time() - begin
        return spent

    counts = (3200, 6400)
    low, high = (weighing(count) for count in counts)  # after the second generation, of twice as many particles
    power = float(np.log(high / low) / np.log(counts[1] / counts[0]))
    return {"weigh_s": high / (2 * counts[1] / 1000) ** power, "weigh_power": power}


def what_travels(model: Model) -> dict[str, float]:
    """Bytes of messages, of the walking task with 20 rollouts of 30 s."""
    large = problem(model, RECORDED, LONG_S)
    commands, scenarios = large.groups[0].measurements[0].commands, large.groups[0].measurements[0].scenario
    rows = Chunk(0, model.mean()[None].repeat(4, axis=0), [scenarios] * 4, [commands] * 4)
    part = _simulated(model, None, None, STEP_S, 0, None, None, rows)
    unit = np.full((1, len(model.names)), 0.5)

    def size(thing: Any) -> int:
        return len(pickle.dumps(thing, protocol=5))

    return {
        "bytes to each chunk, trajectories (4 rollouts of 30 s)": size(rows),
        "bytes back for each rollout of 30 s, trajectories": size(part) / 4,
        "bytes to each chunk, inference (1 particle)": size(unit),
        "bytes shared by all chunks of a generation, inference": size((large.model, large.groups, large.observed)),
        "bytes back for each rollout of 30 s, histograms": size(large.seen(task_features, unit)) / RECORDED,
    }


if __name__ == "__main__":
    sys.exit(main("scale", __doc__, measure))
