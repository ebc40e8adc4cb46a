"""A real servo log: the error on a trajectory that no fit has seen, with and without load-dependent friction.

./tcbi python bench/servo_log.py            # each of the four trajectories held out once
./tcbi python bench/servo_log.py --quick    # the first alone

The recordings (XL330, 4 trajectories at 3 gains each) lie at TCBI_DATA or ../shared/data. Base model and candidate are
fitted alike, by damped Gauss-Newton steps from the best of random starts, to the other three trajectories.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_infer.importer import read_log
from tcbi_infer.mapping import load_mapping
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model

DATA = Path(os.environ.get("TCBI_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "xl330_pendulum"
EFFECT = "load_friction"
RATE_HZ, STEP_S = 100.0, 0.002
STARTS, KEPT, STEPS = 24, 4, 10
ROBUST = np.radians(3.5)  # residuals beyond it count less
TARGET = 0.75  # of the base model's error


class Data:
    """Recordings and what was measured, on the simulation's grid."""

    def __init__(self, recordings: list[Measurement]):
        self.recordings = recordings
        grids = [np.arange(int(m.scenario.duration * RATE_HZ + 1e-6) + 1) / RATE_HZ for m in recordings]
        self.measured = [m.resampled(t).joint_position[:, 0] for m, t in zip(recordings, grids, strict=True)]

    def residuals(self, model: Model, unit: np.ndarray) -> np.ndarray:
        """(N, samples of all recordings) in rad, for (N, P) parameters in the unit cube."""
        commands = [m.commands for m in self.recordings]
        scenarios = [m.scenario for m in self.recordings]
        out = simulate(model, model.from_unit(unit), scenarios, commands=commands, timestep=STEP_S, rate=RATE_HZ)
        predicted = out.joint_position[..., 0]
        rows = [predicted[:, s, : len(y)] - y[: predicted.shape[2]] for s, y in enumerate(self.measured)]
        return np.concatenate(rows, axis=1)


def loss(residual: np.ndarray) -> np.ndarray:
    """Cauchy's, summed over the last axis."""
    return np.sum(ROBUST**2 * np.log1p((residual / ROBUST) ** 2), axis=-1)


def fit(model: Model, data: Data) -> np.ndarray:
    """(P,) in the unit cube: the best of several descents."""
    starts = np.random.default_rng(0).uniform(0.1, 0.9, (STARTS, len(model.names)))
    losses = loss(data.residuals(model, starts))
    ends = [_descend(model, data, starts[i]) for i in np.argsort(losses)[:KEPT]]
    return min(ends, key=lambda end: end[0])[1]


def _descend(model: Model, data: Data, unit: np.ndarray) -> tuple[float, np.ndarray]:
    size, width, best = len(unit), 0.05, np.inf
    for _ in range(STEPS):
        probes = np.clip(np.concatenate([unit[None], unit + width * np.eye(size), unit - width * np.eye(size)]), 0, 1)
        residual = data.residuals(model, probes)
        best = float(loss(residual[0]))
        span = (probes[1 : 1 + size] - probes[1 + size :]).sum(axis=1)
        slopes = ((residual[1 : 1 + size] - residual[1 + size :]) / span[:, None]).T
        weights = 1 / (1 + (residual[0] / ROBUST) ** 2)
        gradient, curvature = slopes.T @ (weights * residual[0]), slopes.T @ (weights[:, None] * slopes)
        damped = [curvature + d * np.diag(np.diag(curvature) + 1e-9) for d in (1e-3, 1e-2, 1e-1, 1.0, 10.0)]
        tries = np.array([np.clip(unit - np.linalg.solve(a, gradient), 0.005, 0.995) for a in damped])
        losses = loss(data.residuals(model, tries))
        if losses.min() < best * (1 - 1e-6):
            unit, best = tries[np.argmin(losses)], float(losses.min())
        elif (width := width / 2.5) < 0.004:
            break
    return best, unit


def measure(quick: bool) -> list[dict[str, Any]]:
    """Held-out errors in degrees, and their ratio over all that was held out."""
    mapping = load_mapping("xl330_bench")
    recordings = [read_log(mapping, path) for path in sorted(DATA.glob("*.json"))]
    names = sorted({m.rollout_id.partition("_")[2] for m in recordings})
    base = base_model("motor_bench")
    models = {"base": base, EFFECT: base.with_effect(EFFECT)}
    figures, squares = [], {name: [] for name in models}
    for held in names[:1] if quick else names:
        seen = Data([m for m in recordings if not m.rollout_id.endswith(held)])
        unseen = Data([m for m in recordings if m.rollout_id.endswith(held)])
        for name, model in models.items():
            error = np.degrees(unseen.residuals(model, fit(model, seen)[None]))
            squares[name].append(np.mean(error**2))
            figures.append(figure(f"{held} held out, {name}", float(np.sqrt(squares[name][-1])), "deg"))
            print(figures[-1], file=sys.stderr, flush=True)
    ratio = float(np.sqrt(np.mean(squares[EFFECT]) / np.mean(squares["base"])))
    return [*figures, figure("held-out error with the effect to without, all trajectories", ratio, "1", TARGET)]


def figure(name: str, value: float, unit: str, target: float | None = None) -> dict[str, Any]:
    """One measured figure beside its target, if it has one."""
    return {
        "name": name,
        "value": round(value, 3),
        "unit": unit,
        "target": target,
        "met": None if target is None else value <= target,
    }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="hold out one trajectory alone")
    options = parser.parse_args()
    if not DATA.is_dir():
        print(f"no recordings at {DATA}; set TCBI_DATA", file=sys.stderr)
        return 1
    print(json.dumps({"name": "servo_log", "figures": measure(options.quick)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
