"""Compares a model's prediction with measured rollouts, signal by signal, beside the noise floor."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tcbi_contract.wording import some
from tcbi_infer.compare import task
from tcbi_infer.compare.common_lag import common_lag, undetectable
from tcbi_infer.compare.errors import CompareError
from tcbi_infer.compare.findings import Finding, Moment
from tcbi_infer.compare.guards import IDLE, IDLE_SPAN, guard, idle_parameter, unchecked, unchecked_line
from tcbi_infer.compare.locate import locate
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.scorer import Scorer, SignalError, Traces, error_over_floor
from tcbi_infer.compare.steadiness import overtaken, unsteady
from tcbi_infer.compare.timestep import USUAL_STEP, fine_step
from tcbi_infer.compare.wiring import unjudged
from tcbi_infer.compare.worst import WorstMoment, worst
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

__all__ = ["Comparison", "SignalError", "compare", "error_figure", "error_over_floor"]

PARTICLES = 16  # simulated for the predictive bands
MOST_PARTICLES = 256
MEMORY = 256 * 2**20  # bytes of predicted channels held at a time


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A model beside measurements.

    Attributes:
      signals: every channel, then distance and reward over time.
      statistics: what the task is about, one figure a rollout: return, final inclination, contact ratios, …
      error_over_floor: root mean square of `ratio` over joints and attitude; infinite where the model diverged.
      guards: findings about the recording and the replay, to be read before any figure.
      unchecked: rollouts of which no clock, wiring or unit could be checked; `unjudged` joints that in the others move
        too little to tell their wiring.
      worst: the moments to look at first, the worst one in front.
      distance: travelled, over time; None where no tracker told.
      predicted: (R, T, C) with the model's mean parameters; `low`, `high` bound the predictive 90 % band.
    """

    model: str
    rollouts: tuple[str, ...]
    signals: tuple[SignalError, ...]
    statistics: tuple[SignalError, ...]
    error_over_floor: float
    floor: NoiseFloor
    guards: tuple[str, ...]
    where: tuple[Finding, ...]
    replay: Replay
    predicted: np.ndarray
    low: np.ndarray
    high: np.ndarray
    worst: tuple[WorstMoment, ...] = ()
    distance: Traces | None = None
    unchecked: tuple[str, ...] = ()
    unjudged: tuple[str, ...] = ()
    timestep: float = USUAL_STEP  # s, of the replay

    @property
    def not_checked(self) -> list[str]:
        """Sentences on what of the recording could not be checked."""
        line = unchecked_line(self.unchecked, self.rollouts)
        told = [line] if line else []
        if self.unjudged:
            told.append(
                "Wiring and sign of these could not be checked, since they or their commands hardly move: "
                f"{some(self.unjudged)}."
            )
        if line := undetectable(self.replay.layout):
            told.append(line)
        return told

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        return {
            "model": self.model,
            "rollouts": list(self.rollouts),
            "signals": [dataclasses.asdict(s) for s in self.signals],
            "statistics": [dataclasses.asdict(s) for s in self.statistics],
            "error_over_floor": self.error_over_floor,
            "floor_from_replicates": self.floor.from_replicates,
            "guards": list(self.guards),
            "timestep": self.timestep,
            "unchecked": list(self.unchecked),
            "unjudged": list(self.unjudged),
            "where": [self._place(f) for f in self.where],
            "worst": [moment.to_json() for moment in self.worst],
        }

    def _place(self, f: Finding) -> dict[str, Any]:
        figures = {"error": f.rms, "elsewhere": f.elsewhere, "error_over_floor": f.over_floor}
        said = {"statement": f.statement, "score": f.score, "signals": list(f.channels), "phase": f.phase}
        return {**said, "kind": f.kind, **figures, "moment": f.moment and self._moment(f.moment)}

    def _moment(self, moment: Moment) -> dict[str, Any]:
        time = self.replay.time[moment.first : moment.first + len(moment.inside)]
        return {
            "rollout": self.rollouts[moment.rollout],
            "time": float(time[0]),
            "until": float(time[-1]),
            "signal": self.replay.layout.channels[moment.channel].name,
        }


def compare(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    parameters: np.ndarray | None = None,
    timestep: float | None = None,
    particles: int = PARTICLES,
    seed: int = 0,
    floor: NoiseFloor | None = None,
) -> Comparison:
    """Replays the recorded commands and measures the error of every signal.

    Args:
      model: whose mean parameters predict and whose particles give the bands.
      measurements: rollouts of the same rig.
      parameters: (P,) to predict with instead of the model's mean.
      timestep: s, of the replay; None for 0.002 s, or less where that alone would move the prediction (`fine_step`).
      particles: simulated for the predictive bands, at most `MOST_PARTICLES`; 0 for none. Memory does not grow with
        them: they are simulated for a few motions at a time.
      seed: of the draw of particles.
      floor: from more rollouts of the same robot than these few; by default these rollouts' own.

    Raises:
      CompareError: nothing to compare, another rig's rollouts, a floor of other signals, or too many particles.
    """
    if not 0 <= particles <= MOST_PARTICLES:
        raise CompareError(f"{particles} particles for the predictive bands, allowed is 0 to {MOST_PARTICLES}")
    replay = Replay.of(model, measurements)
    mean = np.asarray(model.mean() if parameters is None else parameters)
    draws = mean[None]
    if particles and parameters is None:
        draws = model.sample(np.random.default_rng(seed), particles)
    given, step = floor, timestep or USUAL_STEP
    rollouts, predicted = _predicted(replay, model, mean, step)
    floor = given or replay.noise_floor(replay.measured - predicted)
    if timestep is None and (step := fine_step(replay, model, floor.values)) < USUAL_STEP:
        rollouts, predicted = _predicted(replay, model, mean, step)
        floor = given or replay.noise_floor(replay.measured - predicted)
    residual = replay.measured - predicted
    if len(floor.values) != len(replay.layout.channels):
        raise CompareError(f"the floor has {len(floor.values)} signals, these rollouts {len(replay.layout.channels)}")
    scorer = Scorer(replay, floor, predicted, _task_mean(task.predicted(replay, rollouts, _all(replay))))
    for sets in _chunks(replay, len(draws)):
        scorer.take(sets, replay.simulate(model, draws, sets, step))
    names = tuple(m.rollout_id for m in replay.measurements)
    findings = guard(measurements) + common_lag(replay.layout, replay.time, replay.shown, predicted, names)
    findings += _idle_parameters(model, replay, mean, floor.values)
    findings += scorer.divergences()
    findings += [told] if (told := unsteady(replay, floor, overtaken(replay))) else []
    findings += [f"In the fit behind {model.version}: {told}" for told in model.evidence.get("disagreements", ())]
    where = locate(
        load_rig(model.rig), replay.layout, replay.measurements, replay.time, residual, predicted, floor.values
    )
    return Comparison(
        model.version,
        names,
        (*scorer.channel_errors(), *scorer.task_errors(signals=True)),
        scorer.task_errors(signals=False),
        error_over_floor(replay.layout, replay.measured, predicted, floor.values),
        floor,
        tuple(findings),
        tuple(where),
        replay,
        predicted,
        scorer.low,
        scorer.high,
        tuple(worst(replay, predicted, floor.values)),
        scorer.traces(task.DISTANCE),
        unchecked(compared := [m for m in measurements if m.rollout_id in names]),
        unjudged(compared),
        step,
    )


def _predicted(replay: Replay, model: Model, mean: np.ndarray, step: float) -> tuple[SimulatedRollouts, np.ndarray]:
    """The simulations with (P,) parameters, and the (R, T, C) channels that they predict."""
    rollouts = replay.simulate(model, mean[None], timestep=step)
    return rollouts, replay.by_rollout(replay.channels(rollouts)[0])


def error_figure(
    model: Model, measurements: Sequence[Measurement], *, timestep: float = 0.002, floor: NoiseFloor | None = None
) -> float:
    """The one figure of `compare`, without all the rest.

    Raises:
      CompareError: nothing to compare, or another rig's rollouts.
    """
    replay = Replay.of(model, measurements)
    predicted = replay.by_rollout(replay.predict(model, model.mean()[None], timestep=timestep)[0])
    floor = floor or replay.noise_floor(replay.measured - predicted)
    return error_over_floor(replay.layout, replay.measured, predicted, floor.values)


def _all(replay: Replay) -> list[int]:
    return list(range(len(replay.replicates)))


def _chunks(replay: Replay, particles: int) -> Iterator[list[int]]:
    """Replicate sets, as many at a time as fit into `MEMORY`."""
    largest = max(len(g.members) for g in replay.replicates)
    each = particles * largest * len(replay.time) * len(replay.layout.channels) * 8
    count = max(1, MEMORY // each)
    sets = _all(replay)
    for begin in range(0, len(sets), count):
        yield sets[begin : begin + count]


def _task_mean(found: tuple[task.Values, np.ndarray]) -> task.Values:
    """The prediction at the mean parameters in the order of the rollouts."""
    values, owners = found
    return {name: v[0][np.argsort(owners)] for name, v in values.items()}


def _idle_parameters(model: Model, replay: Replay, mean: np.ndarray, floor: np.ndarray) -> list[str]:
    """Parameters that these rollouts cannot speak of, because they change nothing in them."""
    idle, sets = list(range(len(mean))), _all(replay)
    for part in (sets[:3], sets[3:]):  # the first motions clear most parameters
        if part and idle:
            idle = without_change(model, replay, mean, floor, idle, part)
    return [idle_parameter(model.names[p]) for p in idle]


def without_change(
    model: Model, replay: Replay, parameters: np.ndarray, floor: np.ndarray, among: Sequence[int], sets: Sequence[int]
) -> list[int]:
    """Which parameters leave some motions as they are when they go over most of their range.

    Args:
      model: to simulate.
      replay: the rollouts.
      parameters: (P,) physical values of all others.
      floor: (C,) noise floor of the channels.
      among: parameters to look at, of P.
      sets: replicate sets to look at.
    """
    vectors = np.repeat(parameters[None], 2 * len(among), axis=0)
    for k, p in enumerate(among):
        vectors[2 * k, p], vectors[2 * k + 1, p] = (model.parameters[p].from_unit(u) for u in IDLE_SPAN)
    moved = np.zeros(len(among))
    for s in sets:
        predicted = replay.predict(model, vectors, [s], timestep=0.005)[:, 0]
        change = ((predicted[1::2] - predicted[::2]) / floor) ** 2
        told = np.isfinite(change).all(axis=(1, 2))
        moved = np.fmax(moved, np.where(told, np.sqrt(change.mean(axis=1).max(axis=1)), np.inf))
    return [p for k, p in enumerate(among) if moved[k] < IDLE]
