"""What the batch engine costs beside bare stepping, and what a second thread brings; ratios within one run.

./tcbi python bench/engine.py            # seven pairs
./tcbi python bench/engine.py --quick    # three
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from tcbi_bringup.commands.bench import figure
from tcbi_sim.engine import Simulator, simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.mjcf import materialise
from tcbi_sim.model import base_model

STEP_S, DURATION_S = 0.01, 4.0
PARTICLES, ROLLOUTS = 32, 4


def seconds(work: Callable[[], Any]) -> float:
    """Wall time of one run."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def measure(pairs: int) -> list[dict[str, Any]]:
    """Figures; every ratio is the median over pairs of runs in turn."""
    model = base_model("hexapod")
    rng = np.random.default_rng(0)
    values = np.tile([0.75, 0.8, 2.5], (PARTICLES, 1)) * rng.uniform(0.9, 1.1, (PARTICLES, 3))
    scenarios = [Scenario("balance", DURATION_S, settle=0.0) for _ in range(ROLLOUTS)]
    ticks = np.arange(round(DURATION_S / 0.2)) * 0.2
    commands = [Commands(ticks, np.clip(rng.normal(0, 0.15, (len(ticks), 18)), -0.5, 0.5)) for _ in scenarios]
    steps = round(DURATION_S / STEP_S)

    def engine(threads: int) -> None:
        simulate(model, values, scenarios, commands=commands, timestep=STEP_S, threads=threads)

    def control() -> np.ndarray:
        """What the servos track at each step, as the engine makes it, (B, steps, 18)."""
        rows = [scenarios[i % ROLLOUTS] for i in range(PARTICLES * ROLLOUTS)]
        simulator = Simulator(model, np.repeat(values, ROLLOUTS, axis=0), rows, STEP_S)
        for k, t in enumerate(ticks):
            simulator.path.give(float(t), np.stack([commands[i % ROLLOUTS].target[k] for i in range(len(rows))]), 0.2)
        return simulator.path.references((np.arange(steps) + 0.5) * STEP_S, STEP_S)

    given = control()
    own = [materialise(model, v) for v in values for _ in range(ROLLOUTS)]
    for m in own:
        m.opt.timestep = STEP_S

    def bare() -> None:
        batch = Batch(own[0], len(own))
        batch.set_models(own)
        batch.rollout(steps, given, record=("sensordata",))

    def loop() -> None:
        for m, c in zip(own, given, strict=True):
            data = mujoco.MjData(m)
            for row in c:
                data.ctrl[:] = row
                mujoco.mj_step(m, data)

    overhead, threads, plain = [], [], []
    engine(0)
    for _ in range(pairs):
        two, stepping = seconds(lambda: engine(0)), seconds(bare)
        overhead.append(two / stepping)
        threads.append(seconds(lambda: engine(1)) / two)
        plain.append(seconds(loop) / stepping)
    return [
        figure("engine to bare batched stepping, median", statistics.median(overhead), "1", most=1.05),
        figure("one thread to all threads, median", statistics.median(threads), "1", least=1.8),
        figure("plain loop to bare batched stepping, median", statistics.median(plain), "1", least=1.8),
    ]


def main(name: str, doc: str, figures: Callable[[int], list[dict[str, Any]]]) -> int:
    """Measure in pairs and print."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three pairs")
    options = parser.parse_args()
    print(json.dumps({"name": name, "figures": figures(3 if options.quick else 7)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main("engine", __doc__, measure))
