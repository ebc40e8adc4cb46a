"""Errors, bands and scores of every signal, collected while particles are simulated for a few motions at a time."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare import task
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.scores import crps, predictive_band
from tcbi_infer.compare.signals import ATTITUDE, JOINT, Group, Layout
from tcbi_sim.engine import SimulatedRollouts

NAMED = 3  # rollouts that a sentence names
REPLICATES, RESIDUAL, LEAST = "replicates", "residual", "minimum"  # where a noise floor comes from


@dataclasses.dataclass(frozen=True)
class SignalError:
    """The error of one signal's or statistic's prediction, root mean square over all samples.

    Attributes:
      ratio: error / noise floor.
      coverage90: share of samples inside the predictive 90 % band.
      crps: mean continuous ranked probability score, in the signal's unit; noise alone gives 0.56 x the noise floor.
      floor_from: "replicates", "residual" where no commands were repeated, or "minimum" where either says less than
        is credible.
    """

    name: str
    unit: str
    error: float
    noise_floor: float
    ratio: float
    coverage90: float
    crps: float
    floor_from: str


@dataclasses.dataclass(frozen=True)
class Traces:
    """One signal of the task over time: (R, K) measured, predicted at the mean, and the predictive 90 % band."""

    measured: np.ndarray
    predicted: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Scorer:
    """Collects bands and scores while the particles are simulated for a few motions at a time."""

    def __init__(self, replay: Replay, floor: NoiseFloor, predicted: np.ndarray, mean: task.Values) -> None:
        self.replay, self.floor, self.predicted, self.mean = replay, floor, predicted, mean
        self.low, self.high = np.full_like(predicted, np.nan), np.full_like(predicted, np.nan)
        self.kept = replay.layout.kept(predicted.shape[1]) & np.isfinite(replay.measured)
        self.score = np.full_like(predicted, np.nan)
        self.lost = diverged(replay.layout, replay.measured, predicted)
        self.failed: dict[int, np.ndarray] = {}  # replicate set -> (N,) bool, particles that diverged in it
        self.observed = task.measured(replay)
        self.floors = task.floors(replay, self.observed, mean)
        self.inside = {name: np.full(self.observed[name].shape, np.nan) for name in self.floors}
        self.bands = {name: np.full((2, *self.observed[name].shape), np.nan) for name in self.floors}
        self.task_score = {name: np.full(self.observed[name].shape, np.nan) for name in self.floors}

    def take(self, sets: Sequence[int], rollouts: SimulatedRollouts) -> None:
        """Simulations (N, len(sets)) of some replicate sets."""
        channels = self.replay.channels(rollouts)
        for s, number in enumerate(sets):
            members = list(self.replay.replicates[number].members)
            self.failed[number] = rollouts.diverged[:, s]
            draws = channels[~rollouts.diverged[:, s], s]
            if not len(draws):
                continue
            self.low[members], self.high[members] = predictive_band(draws, self.floor.values)
            for r in members:
                t, c = np.nonzero(self.kept[r])
                self.score[r, t, c] = crps(self.replay.measured[r, t, c], draws[:, t, c], self.floor.values[c])
        values, owners = task.predicted(self.replay, rollouts, sets)
        for name in [name for name in self.floors if name in values]:
            self._take_task(name, values[name], owners)

    def _take_task(self, name: str, values: np.ndarray, owners: np.ndarray) -> None:
        sigma = self.floors[name].value
        for i, r in enumerate(owners):
            draws = values[:, i]
            draws = draws[~np.isnan(draws).all(axis=-1)]
            if not len(draws) or not np.isfinite(sigma):
                continue
            seen = self.observed[name][r]
            low, high = predictive_band(draws, sigma)
            self.bands[name][:, r] = low, high
            told = np.isfinite(seen) & np.isfinite(low)
            self.inside[name][r] = np.where(told, (seen >= low) & (seen <= high), np.nan)
            self.task_score[name][r] = crps(seen, draws, sigma)

    def divergences(self) -> list[str]:
        """A sentence on the predictions at the mean that diverged, and one on the particles."""
        names = [m.rollout_id for m in self.replay.measurements]
        found = []
        if self.lost.any():
            found.append(
                "The simulation at the model's mean parameters diverged in "
                f"{in_words(np.flatnonzero(self.lost), names)}: the error counts as infinite there, and nothing that "
                "is told of places and moments comes from there."
            )
        failed = np.array([self.failed[s] for s in sorted(self.failed)])  # (S, N)
        if failed.any() and not (failed.shape[1] == 1 and self.lost.any()):
            where = [r for s in np.flatnonzero(failed.any(axis=1)) for r in self.replay.replicates[s].members]
            found.append(
                f"{failed.any(axis=0).sum()} of {failed.shape[1]} particles diverged in "
                f"{in_words(sorted(where), names)}: the bands, their coverage and the CRPS leave them out there, and "
                "look better than they are."
            )
        return found

    def traces(self, name: str) -> Traces | None:
        """A task signal over time; None where it was not measured or cannot be predicted."""
        if name not in self.floors or not np.isfinite(self.observed[name] - self.mean[name]).any():
            return None
        return Traces(self.observed[name], self.mean[name], *self.bands[name])

    def channel_errors(self) -> tuple[SignalError, ...]:
        """The error of every channel that was measured."""
        layout, floor = self.replay.layout, self.floor
        ratio = ratios(layout, self.replay.measured, self.predicted, floor.values)
        kept = self.kept & np.isfinite(self.low)
        inside = kept & (self.replay.measured >= self.low) & (self.replay.measured <= self.high)
        with np.errstate(invalid="ignore", divide="ignore"):
            coverage = inside.sum(axis=(0, 1)) / kept.sum(axis=(0, 1))
        return tuple(
            SignalError(
                c.name, c.group.unit, float(ratio[i] * floor.values[i]), float(floor.values[i]), float(ratio[i]),
                float(coverage[i]), _mean(self.score[..., i]),
                _source(floor.replicated(i), floor.values[i], c.group.resolution),
            )
            for i, c in enumerate(layout.channels)
            if not np.isnan(ratio[i])
        )  # fmt: skip

    def task_errors(self, signals: bool) -> tuple[SignalError, ...]:
        """The error of the task's signals, or of its statistics."""
        errors = []
        for name, floor in self.floors.items():
            squares = (self.observed[name] - self.mean[name]) ** 2
            squares[self.lost[:, None] & np.isfinite(self.observed[name])] = np.inf
            if (name in task.SIGNALS) != signals or np.isnan(squares).all():
                continue
            error, sigma = float(np.sqrt(np.nanmean(squares))), floor.value
            coverage, score = _mean(self.inside[name]), _mean(self.task_score[name])
            errors.append(
                SignalError(
                    name,
                    task.unit(name),
                    error,
                    sigma,
                    error / sigma,
                    coverage,
                    score,
                    _source(floor.from_replicates, sigma, task.least(name)),
                )
            )
        return tuple(errors)


def diverged(layout: Layout, measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(R,) bool: rollouts whose joints were measured, but not predicted; a rig may lack the other sensors."""
    joints = layout.where(JOINT)
    return (np.isfinite(measured) & ~np.isfinite(predicted))[..., joints].any(axis=(1, 2))


def ratios(layout: Layout, measured: np.ndarray, predicted: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(C,) root mean square error of each channel over its noise floor.

    NaN where nothing was measured or can be predicted; infinite where a rollout's prediction diverged.
    """
    residual = measured - predicted
    residual[diverged(layout, measured, predicted)[:, None, None] & np.isfinite(measured)] = np.inf
    kept = layout.kept(residual.shape[1]) & ~np.isnan(residual)
    count = kept.sum(axis=(0, 1))
    squares = np.where(kept, residual**2, 0.0).sum(axis=(0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(squares / count) / floor


def error_over_floor(
    layout: Layout,
    measured: np.ndarray,
    predicted: np.ndarray,
    floor: np.ndarray,
    groups: Sequence[Group] = (JOINT, ATTITUDE),
) -> float:
    """The one figure for a model: root mean square, over joints and attitude, of error over noise floor.

    1 means that the model predicts the robot as well as the robot repeats itself. A model that diverges in a rollout
    has an infinite error, else it would be judged by the easier ones alone.

    Args:
      layout: the channels.
      measured: (R, T, C), NaN where missing, which is left out.
      predicted: (R, T, C), NaN where diverged.
      floor: (C,).
      groups: whose channels count, if not those of joints and attitude.
    """
    return float(np.sqrt(np.nanmean(ratios(layout, measured, predicted, floor)[layout.where(*groups)] ** 2)))


def _mean(values: np.ndarray) -> float:
    """Of what is there; NaN of nothing."""
    there = values[np.isfinite(values)]
    return float(there.mean()) if len(there) else float("nan")


def in_words(which: Sequence[int] | np.ndarray, names: Sequence[str]) -> str:
    """Rollouts in words: how many of how many, and the first ones by name."""
    more = f" and {len(which) - NAMED} more" if len(which) > NAMED else ""
    return f"{len(which)} of {len(names)} rollouts ({', '.join(names[r] for r in which[:NAMED])}{more})"


def _source(repeated: bool, sigma: float, least: float) -> str:
    return LEAST if sigma <= least else REPLICATES if repeated else RESIDUAL
