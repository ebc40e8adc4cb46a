"""Compares a model's prediction with measured rollouts, signal by signal, beside the noise floor."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_infer.compare.errors import CompareError
from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.locate import Finding, locate
from tcbi_infer.compare.noise import NoiseFloor, noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import ATTITUDE, JOINT, Layout
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

PARTICLES = 16  # simulated for the predictive bands
IDLE = 0.05  # of the noise floor: a parameter that moves every signal less than this changes nothing


@dataclasses.dataclass(frozen=True)
class SignalError:
    """The error of one signal's prediction, root mean square over all samples."""

    name: str
    unit: str
    error: float
    noise_floor: float
    ratio: float  # error / noise floor
    coverage90: float  # share of samples inside the predictive 90 % band; NaN if the model is a single point


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A model beside measurements.

    Attributes:
      error_over_floor: root mean square of `ratio` over joints and attitude.
      guards: findings about the recording and the replay, to be read before any figure.
      predicted: (R, T, C) with the model's mean parameters; `low`, `high` bound the predictive 90 % band.
    """

    model: str
    rollouts: tuple[str, ...]
    signals: tuple[SignalError, ...]
    error_over_floor: float
    floor: NoiseFloor
    guards: tuple[str, ...]
    where: tuple[Finding, ...]
    replay: Replay
    predicted: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        return {
            "model": self.model,
            "rollouts": list(self.rollouts),
            "signals": [dataclasses.asdict(s) for s in self.signals],
            "error_over_floor": self.error_over_floor,
            "floor_from_replicates": self.floor.from_replicates,
            "guards": list(self.guards),
            "where": [{"statement": f.statement, "score": f.score} for f in self.where],
        }


def compare(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    parameters: np.ndarray | None = None,
    timestep: float = 0.002,
    particles: int = PARTICLES,
    seed: int = 0,
    floor: NoiseFloor | None = None,
) -> Comparison:
    """Replays the recorded commands and measures the error of every signal.

    Args:
      model: whose mean parameters predict and whose particles give the bands.
      measurements: rollouts of the same rig.
      parameters: (P,) to predict with instead of the model's mean.
      timestep: s, of the replay.
      particles: simulated for the predictive bands; 0 for none.
      seed: of the draw of particles.
      floor: from more rollouts of the same robot than these few; by default these rollouts' own.

    Raises:
      CompareError: nothing to compare, another rig's rollouts, or a floor of other signals.
    """
    replay = Replay.of(model, measurements)
    mean = np.asarray(model.mean() if parameters is None else parameters)
    rng = np.random.default_rng(seed)
    draws = model.sample(rng, particles) if particles and parameters is None else np.empty((0, len(mean)))
    predicted = replay.predict(model, np.concatenate([mean[None], draws]), timestep=timestep)
    by_rollout = replay.by_rollout(predicted)
    residual = replay.measured - by_rollout[0]
    floor = floor or noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    if len(floor.values) != len(replay.layout.channels):
        raise CompareError(f"the floor has {len(floor.values)} signals, these rollouts {len(replay.layout.channels)}")
    low, high = predictive_band(by_rollout[1:] if len(draws) else by_rollout, floor.values)
    findings = guard(measurements) + _idle_parameters(model, replay, mean, floor.values)
    if not np.isfinite(by_rollout[0]).any():
        findings.append("The simulation at the model's mean parameters diverged, so there is no prediction.")
    where = locate(
        load_rig(model.rig), replay.layout, replay.measurements, replay.time, residual, by_rollout[0], floor.values
    )
    signals = signal_errors(replay.layout, residual, floor.values, replay.measured, low, high)
    return Comparison(
        model.version,
        tuple(m.rollout_id for m in replay.measurements),
        signals,
        error_over_floor(replay.layout, residual, floor.values),
        floor,
        tuple(findings),
        tuple(where),
        replay,
        by_rollout[0],
        low,
        high,
    )


def ratios(layout: Layout, residual: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(C,) root mean square error of each channel over its noise floor; NaN where nothing was measured."""
    kept = layout.kept(residual.shape[1]) & np.isfinite(residual)
    count = kept.sum(axis=(0, 1))
    squares = np.where(kept, np.nan_to_num(residual) ** 2, 0.0).sum(axis=(0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(squares / count) / floor


def error_over_floor(layout: Layout, residual: np.ndarray, floor: np.ndarray) -> float:
    """The one figure for a model: root mean square, over joints and attitude, of error over noise floor.

    1 means that the model predicts the robot as well as the robot repeats itself.

    Args:
      layout: the channels.
      residual: (R, T, C) measured less predicted.
      floor: (C,).
    """
    return float(np.sqrt(np.nanmean(ratios(layout, residual, floor)[layout.where(JOINT, ATTITUDE)] ** 2)))


def signal_errors(
    layout: Layout, residual: np.ndarray, floor: np.ndarray, measured: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[SignalError, ...]:
    """The error of every channel that was measured."""
    ratio = ratios(layout, residual, floor)
    kept = layout.kept(residual.shape[1]) & np.isfinite(measured) & np.isfinite(low)
    inside = kept & (measured >= low) & (measured <= high)
    with np.errstate(invalid="ignore", divide="ignore"):
        coverage = inside.sum(axis=(0, 1)) / kept.sum(axis=(0, 1))
    return tuple(
        SignalError(
            c.name, c.group.unit, float(ratio[i] * floor[i]), float(floor[i]), float(ratio[i]), float(coverage[i])
        )
        for i, c in enumerate(layout.channels)
        if np.isfinite(ratio[i])
    )


def predictive_band(predicted: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The central 90 % of what the model says would be measured, noise included.

    Args:
      predicted: (N, R, T, C) one prediction for each draw of the parameters.
      floor: (C,) standard deviation of the noise.

    Returns:
      low, high: (R, T, C).
    """
    if len(predicted) == 1:
        return predicted[0] - 1.645 * floor, predicted[0] + 1.645 * floor
    spread = np.nanstd(predicted, axis=0)
    middle = np.nanmean(predicted, axis=0)
    half = 1.645 * np.sqrt(spread**2 + floor**2)
    return middle - half, middle + half


def _idle_parameters(model: Model, replay: Replay, mean: np.ndarray, floor: np.ndarray) -> list[str]:
    """Parameters that these rollouts cannot speak of, because they change nothing in them."""
    vectors = np.repeat(mean[None], 2 * len(mean), axis=0)
    for p, parameter in enumerate(model.parameters):
        vectors[2 * p, p], vectors[2 * p + 1, p] = parameter.from_unit(0.2), parameter.from_unit(0.8)
    sets = list(range(min(3, len(replay.replicates))))
    predicted = replay.predict(model, vectors, sets, timestep=0.005)
    sentences = []
    for p, parameter in enumerate(model.parameters):
        change = (predicted[2 * p + 1] - predicted[2 * p]) / floor
        if np.isfinite(change).any() and np.sqrt(np.nanmax(np.nanmean(change**2, axis=(0, 1)))) < IDLE:
            sentences.append(f"The model's parameter {parameter.name} changes nothing in these rollouts.")
    return sentences
