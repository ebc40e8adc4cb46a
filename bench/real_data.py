"""Three real recordings: held-out errors without and with effects, and what mujoco.sysid makes of the same data.

./tcbi python bench/real_data.py            # XL330 pendulum (trajectories and gains held out), SO-101, double pendulum
./tcbi python bench/real_data.py --quick    # one trajectory of the XL330 alone, without mujoco.sysid
./tcbi python bench/real_data.py --only so101

The recordings lie at TCBI_DATA or ../shared/data. Every model is fitted alike, by damped Gauss-Newton steps from the
nominal values and from the best of random starts, to recordings that are not those it is judged on. Times are of the
processor. mujoco.sysid is compared where it is installed (`uv pip install "mujoco[sysid]"`).
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_bringup.commands.bench import figure
from tcbi_infer.importer import read_log, read_rollouts
from tcbi_infer.mapping import load_mapping
from tcbi_infer.pieces import pieces
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model

DATA = Path(os.environ.get("TCBI_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@dataclass(frozen=True)
class Effort:
    """How a model is fitted."""

    starts: int = 16
    kept: int = 2
    steps: int = 8
    timestep: float = 0.005  # s
    rate: float = 50.0  # Hz
    robust: float = float(np.radians(3.5))  # residuals beyond it count less


class Data:
    """Recordings and what was measured, on the simulation's grid."""

    def __init__(self, recordings: list[Measurement], effort: Effort):
        self.recordings, self.effort = recordings, effort
        grids = [np.arange(int(m.scenario.duration * effort.rate + 1e-6) + 1) / effort.rate for m in recordings]
        self.measured = [m.resampled(t).joint_position for m, t in zip(recordings, grids, strict=True)]

    def residuals(self, model: Model, values: np.ndarray) -> np.ndarray:
        """(N, samples of all recordings, J) in rad, for (N, P) parameters."""
        commands, scenarios = [m.commands for m in self.recordings], [m.scenario for m in self.recordings]
        step, rate = self.effort.timestep, self.effort.rate
        out = simulate(model, values, scenarios, commands=commands, timestep=step, rate=rate)
        rows = [out.joint_position[:, s, : len(y)] - y[: len(out.time)] for s, y in enumerate(self.measured)]
        joined = np.concatenate(rows, axis=1)
        return np.where(np.isfinite(joined), joined, np.pi)  # a simulation that diverged is far off


class Fitter:
    """Robust least squares for one model."""

    def __init__(self, model: Model, data: Data):
        self.model, self.data, self.robust = model, data, data.effort.robust

    def fit(self) -> np.ndarray:
        """(P,) the best of several descents."""
        nominal = self.model.to_unit(np.array([p.nominal for p in self.model.parameters]))
        ends = [self._descend(start) for start in (nominal, *self._random_starts())]
        return self.model.from_unit(min(ends, key=lambda end: end[0])[1])

    def _random_starts(self) -> np.ndarray:
        """(kept, P) the best of many."""
        effort = self.data.effort
        if not effort.kept:
            return np.empty((0, len(self.model.names)))
        starts = np.random.default_rng(0).uniform(0.1, 0.9, (effort.starts, len(self.model.names)))
        return starts[np.argsort(self._loss(self._residuals(starts)))[: effort.kept]]

    def _residuals(self, unit: np.ndarray) -> np.ndarray:
        return self.data.residuals(self.model, self.model.from_unit(unit)).reshape(len(unit), -1)

    def _loss(self, residual: np.ndarray) -> np.ndarray:
        """Cauchy's, summed over the last axis."""
        return np.sum(self.robust**2 * np.log1p((residual / self.robust) ** 2), axis=-1)

    def _descend(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        size, width, best = len(unit), 0.05, np.inf
        for _ in range(self.data.effort.steps):
            probes = np.clip(
                np.concatenate([unit[None], unit + width * np.eye(size), unit - width * np.eye(size)]), 0, 1
            )
            residual = self._residuals(probes)
            best = float(self._loss(residual[0]))
            span = (probes[1 : 1 + size] - probes[1 + size :]).sum(axis=1)
            slopes = ((residual[1 : 1 + size] - residual[1 + size :]) / span[:, None]).T
            weights = 1 / (1 + (residual[0] / self.robust) ** 2)
            gradient, curvature = slopes.T @ (weights * residual[0]), slopes.T @ (weights[:, None] * slopes)
            damped = [curvature + d * np.diag(np.diag(curvature) + 1e-9) for d in (1e-3, 1e-2, 1e-1, 1.0, 10.0)]
            tries = np.array([np.clip(unit - np.linalg.solve(a, gradient), 0.005, 0.995) for a in damped])
            losses = self._loss(self._residuals(tries))
            if losses.min() < best * (1 - 1e-6):
                unit, best = tries[np.argmin(losses)], float(losses.min())
            elif (width := width / 2.5) < 0.004:
                break
        return best, unit


@dataclass(frozen=True)
class Fitted:
    """A model fitted to some recordings and judged on others."""

    values: dict[str, float]
    error: np.ndarray  # (J,) deg, root mean square on the recordings held out


def judge(rig: str, effects: tuple[str, ...], seen: Data, unseen: Data) -> Fitted:
    """Fit to what is seen, measure on what is not."""
    model = base_model(rig)
    for effect in effects:
        model = model.with_effect(effect)
    values = Fitter(model, seen).fit()
    error = np.degrees(np.sqrt(np.mean(unseen.residuals(model, values[None])[0] ** 2, axis=0)))
    return Fitted(dict(zip(model.names, map(float, values), strict=True)), error)


TRAJECTORY, GAIN = 1, 0  # parts of the name of a recording of the pendulum, kp200_sin_sin


def pendulum(by: int, quick: bool = False) -> list[dict[str, Any]]:
    """One servo: stiffness, viscous and Coulomb friction, without and with friction that grows with the load.

    Args:
      by: what is held out in turn, each trajectory (another motion than those of the fit) or each gain.
      quick: the first trajectory alone, fitted coarsely.
    """
    recordings = [
        read_log(load_mapping("xl330_bench"), path) for path in sorted((DATA / "xl330_pendulum").glob("*.json"))
    ]
    kind = {m.rollout_id: m.rollout_id.split("_", 1)[by] for m in recordings}
    kinds = sorted(set(kind.values()))
    effort = Effort(starts=8, kept=1, steps=6) if quick else Effort(starts=48, kept=3, steps=14)
    figures: list[dict[str, Any]] = []
    squares: dict[str, list[float]] = {"": [], "load_friction": []}
    for held in kinds[:1] if quick else kinds:
        seen = Data([m for m in recordings if kind[m.rollout_id] != held], effort)
        unseen = Data([m for m in recordings if kind[m.rollout_id] == held], effort)
        for effect in squares:
            fitted = judge("motor_bench", (effect,) if effect else (), seen, unseen)
            squares[effect].append(fitted.error[0] ** 2)
            figures.append(told(f"xl330: {held} held out, {effect or 'base'}", fitted.error[0], "deg"))
    ratio = np.sqrt(np.mean(squares["load_friction"]) / np.mean(squares[""]))
    what = "trajectories" if by == TRAJECTORY else "gains"
    name = f"xl330: error with load_friction to without, all {what} held out in turn"
    return [*figures, told(name, ratio, "1", most=0.75)]


def arm() -> list[dict[str, Any]]:
    """Six servos: the ideal servo, which is at its command, and what the elbow needs beside it."""
    effort = Effort(kept=0, steps=6)
    mapping = load_mapping("so101_arm")
    logs = {path.name: read_log(mapping, path) for path in sorted((DATA / "so101_arm").iterdir()) if path.is_dir()}
    chosen = ("static_holding", "velocity_ramp", "chirp_sweep", "backlash_detection")
    seen = Data([p for name in chosen for p in pieces(logs[name], 15.0)[2::4]], effort)
    unseen = Data([m for name, m in logs.items() if name not in chosen], effort)
    ideal = ideal_servo(unseen)
    elbow, figures = mapping.joints.index("Elbow"), []
    figures.append(told("so101: elbow, ideal servo", ideal[elbow], "deg"))
    chain = ((), ("gravity_droop:Elbow",), ("gravity_droop:Elbow", "load_friction"))
    fits = {effects: judge("so101_arm", effects, seen, unseen) for effects in chain}
    for effects, fitted in fits.items():
        name = " + ".join(("lag", *effects))
        figures.append(told(f"so101: elbow, {name}", fitted.error[elbow], "deg"))
    ratio = fits[chain[-1]].error[elbow] / ideal[elbow]
    figures.append(told("so101: elbow's error to the ideal servo's", ratio, "1", most=0.5))
    for joint in ("Wrist_Roll", "Jaw"):
        k = mapping.joints.index(joint)
        drooping = judge("so101_arm", (f"gravity_droop:{joint}",), seen, unseen).error[k]
        name = f"so101: {joint}, error with gravity_droop to without"
        figures.append(told(name, drooping / fits[()].error[k], "1", least=0.99))
    return figures


def ideal_servo(data: Data) -> np.ndarray:
    """(J,) deg by which joints depart from their commands."""
    rows = []
    for m, measured in zip(data.recordings, data.measured, strict=True):
        times = np.arange(len(measured)) / data.effort.rate
        newest = np.searchsorted(m.commands.time, times, side="right") - 1
        rows.append(m.commands.target[np.clip(newest, 0, None)] - measured)
    return np.degrees(np.sqrt(np.mean(np.concatenate(rows) ** 2, axis=0)))


def double_pendulum() -> list[dict[str, Any]]:
    """Two motors: a frictionless model, and what it lacks."""
    effort = Effort(kept=1, timestep=0.002, rate=100.0)
    seen, unseen = _double_pendulum(effort)
    figures = []
    for effects in ((), ("viscous_damping",), ("coulomb_friction",)):
        fitted = judge("double_pendulum", effects, seen, unseen)
        name = f"double pendulum: {' + '.join(('masses and rotor', *effects))}"
        figures.append(told(f"{name}, both joints", float(np.sqrt(np.mean(fitted.error**2))), "deg"))
    torque = fitted.values["coulomb_friction.torque"]
    return [*figures, told("double pendulum: Coulomb friction", torque, "N m", least=0.07, most=0.11)]


def _double_pendulum(effort: Effort) -> tuple[Data, Data]:
    logs = sorted((DATA / "double_pendulum").glob("*.csv.gz"))
    parts = [p for log in logs for p in read_rollouts(load_mapping("double_pendulum"), log)]
    held = [logs[k].name.removesuffix(".csv.gz") for k in (1, 3)]
    seen, unseen = [p for p in parts if p.policy_id not in held], [p for p in parts if p.policy_id in held]
    return Data(seen, effort), Data(unseen, effort)


def peer() -> list[dict[str, Any]]:
    """mujoco.sysid on the same three, fitted to the same and judged on the same; nothing where it is not installed."""
    try:
        from peers.mujoco_sysid import compare
    except (ImportError, AttributeError) as e:  # without what the extra brings the module is there, and empty
        print(f"mujoco.sysid is left out ({e}); install mujoco[sysid]", file=sys.stderr)
        return []
    return [told(name, value, unit) for name, value, unit in compare(DATA)]


def told(name: str, value: float, unit: str, **target: float) -> dict[str, Any]:
    """A figure, said at once: the whole takes minutes."""
    found = figure(name, value, unit, **target)
    print(f"{name}: {found['value']} {unit}", file=sys.stderr, flush=True)
    return found


def timed(part: Callable[[], list[dict[str, Any]]], name: str) -> list[dict[str, Any]]:
    """A part's figures and the time that it took."""
    began = time.process_time()
    return [*part(), told(f"{name}: processor time", time.process_time() - began, "s")]


PARTS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "xl330": lambda: pendulum(TRAJECTORY),
    "xl330_gains": lambda: pendulum(GAIN),
    "so101": arm,
    "double_pendulum": double_pendulum,
    "sysid": peer,
}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one trajectory of the XL330 alone")
    parser.add_argument("--only", choices=tuple(PARTS), action="append", help="one part; may be given again")
    options = parser.parse_args()
    if not DATA.is_dir():
        print(f"no recordings at {DATA}; set TCBI_DATA", file=sys.stderr)
        return 1
    chosen = options.only or list(PARTS)
    if options.quick:
        figures = pendulum(TRAJECTORY, quick=True)
    else:
        figures = [found for name in chosen for found in timed(PARTS[name], name)]
    print(json.dumps({"name": "real_data", "figures": figures}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
