"""Recorded commands replayed in the model: predicted channels for many parameter vectors at once."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from tcbi_infer.compare.clocks import aligned
from tcbi_infer.compare.errors import NothingToCompareError, WrongJointsError, WrongRigError
from tcbi_infer.compare.lengths import extended, side_by_side
from tcbi_infer.compare.noise import NoiseFloor, mean_of, noise_floor, originals
from tcbi_infer.compare.replicates import Replicates, find_replicates
from tcbi_infer.compare.signals import GROUPS, Layout, window_mean
from tcbi_infer.gaps import unusable
from tcbi_infer.spikes import without_spikes
from tcbi_sim.engine import SimulatedRollouts, simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig, missing_sensors

LEAST_SAMPLES = 10
SPREAD = 1.5  # sets whose lengths differ by less are simulated together
NEAR = 0.2  # periods of a slow recording from one of its readings: further off a sample has less noise than these
SETTLE_S = 0.3  # s at most in the first posture: robots simulated with their true parameters err as with 1 s
SLOW = 1.5  # periods of the grid between two readings: more leave samples that no reading stands for


@dataclasses.dataclass(frozen=True)
class Replay:
    """Measurements on a common grid, and what to simulate for them: one simulation for each set of replicates.

    Attributes:
      rig: name of the rig.
      layout: the channels.
      measurements: (R) rollouts, sampled at `time`.
      time: (T,) s.
      measured: (R, T, C) channels, NaN where not measured or after a rollout's end. Of a slow recording the samples
        next to its own readings, by a curve through these.
      shown: (R, T, C) the same, for pictures: between slow readings, too.
      replicates: (S) sets of rollouts that were asked for the same thing.
      readings: (R, T) bool, samples at which a rollout has readings of its own, whose noise interpolation has left.
    """

    rig: str
    layout: Layout
    measurements: tuple[Measurement, ...]
    time: np.ndarray
    measured: np.ndarray
    shown: np.ndarray
    replicates: tuple[Replicates, ...]
    scenarios: tuple[Scenario, ...]
    commands: tuple[Commands, ...]
    readings: np.ndarray

    @staticmethod
    def of(model: Model, measurements: Sequence[Measurement], rate: float | None = None) -> "Replay":
        """Prepares rollouts for comparison with a model; lags that only the clocks can have are taken out.

        Raises:
          NothingToCompareError: there are no usable rollouts.
          WrongRigError: a rollout is of another robot.
          WrongJointsError: a rollout has other joints than its rig.
        """
        rig = load_rig(model.rig)
        useless = {m.rollout_id: told for m in measurements if (told := _useless(m, rate or rig.rate))}
        lacking: dict[str, Any] = dict.fromkeys(missing_sensors(rig))
        kept = (without_spikes(m) for m in measurements if m.rollout_id not in useless)
        usable = [dataclasses.replace(m, **lacking) for m in kept]
        if not usable:
            raise NothingToCompareError(useless)
        for m in usable:
            if m.rig != model.rig:
                raise WrongRigError(model.version, model.rig, m.rig, m.joint_names)
            if m.joint_names != rig.joint_names:
                raise WrongJointsError(m.rig, rig.joint_names, m.joint_names)
        usable = list(aligned(usable).measurements)
        rate = rate or rig.rate
        layout = Layout.of(usable, rate)
        ends = [min(m.scenario.duration, float(m.time[-1])) for m in usable]
        time = np.arange(1, int(np.floor(max(ends) * rate + 1e-6)) + 1) / rate
        sampled = tuple(m.resampled(time, curved=_slow(m.time, rate)) for m in usable)
        shown = np.stack([layout.extract(m) for m in sampled])
        for r, (m, end) in enumerate(zip(usable, ends, strict=True)):
            shown[r, (time > end + 1e-6) | (time < m.time[0] - 1.0 / rate)] = np.nan
            shown[r, _spoilt(layout, m, time)] = np.nan
        measured = np.where(np.stack([_known(layout, m.time, time) for m in usable]), shown, np.nan)
        replicates = tuple(find_replicates(usable))
        scenarios, commands = zip(*[_asked(usable, g, float(time[-1])) for g in replicates], strict=True)
        readings = np.stack([_readings(m.time, time, rate) for m in usable])
        return Replay(model.rig, layout, sampled, time, measured, shown, replicates, scenarios, commands, readings)

    def predict(
        self, model: Model, parameters: np.ndarray, sets: Sequence[int] | None = None, timestep: float = 0.002
    ) -> np.ndarray:
        """Simulates the commands of some replicate sets.

        Args:
          model: its structure; the parameters come from the next argument.
          parameters: (N, P) vectors.
          sets: which replicate sets; all by default.
          timestep: s.

        Returns:
          (N, len(sets), T, C) predicted channels; NaN for simulations that diverged.
        """
        return self.channels(self.simulate(model, parameters, sets, timestep))

    def simulate(
        self, model: Model, parameters: np.ndarray, sets: Sequence[int] | None = None, timestep: float = 0.002
    ) -> SimulatedRollouts:
        """The simulations behind `predict`, with everything that they sense.

        A set that is much shorter than the longest one is simulated to about its own end only, and repeats its last
        sample from there on: nothing was measured there.
        """
        chosen = np.array(range(len(self.replicates)) if sets is None else sets, int)
        places, parts = [], []
        for samples in np.unique(self._lengths[chosen]):
            places.append(np.flatnonzero(self._lengths[chosen] == samples))
            own, end = chosen[places[-1]], float(self.time[samples - 1])
            whole = samples == len(self.time)
            scenarios = [self.scenarios[s] for s in own]
            part = simulate(
                model,
                np.atleast_2d(parameters),
                scenarios if whole else [dataclasses.replace(s, duration=end) for s in scenarios],
                commands=[self.commands[s] for s in own],
                timestep=timestep,
                rate=self.layout.rate,
            )
            parts.append(part if whole else extended(part, scenarios, np.concatenate([[0.0], self.time])))
        return parts[0] if len(parts) == 1 else side_by_side(parts, np.argsort(np.concatenate(places)))

    @cached_property
    def _lengths(self) -> np.ndarray:
        """(S,) samples to simulate of each set: to the end of the longest of those that last about as long.

        A few more than were measured, so that averages at the end are those of a longer simulation.
        """
        every = len(self.time)
        result = np.full(len(self.replicates), every)
        if not len(self.measured):
            return result
        there = np.isfinite(self.measured).any(axis=2)
        ends = np.where(there.any(axis=1), every - np.argmax(there[:, ::-1], axis=1), 0)
        own = np.array([max(ends[r] for r in g.members) for g in self.replicates])
        own += max(self.layout.samples_in(c.group) for c in self.layout.channels)
        left = own * SPREAD < every
        while left.any():
            longest = own[left].max()
            result[left] = longest
            left &= own * SPREAD < longest
        return result

    def channels(self, rollouts: SimulatedRollouts) -> np.ndarray:
        """(N, S, T, C) channels of simulations; NaN for those that diverged."""
        predicted = self.layout.extract(rollouts)[:, :, -len(self.time) :]
        predicted[rollouts.diverged] = np.nan
        return predicted

    def by_rollout(self, predicted: np.ndarray) -> np.ndarray:
        """(..., S, T, C) of replicate sets -> (..., R, T, C) of rollouts."""
        owner = np.empty(len(self.measurements), int)
        for s, group in enumerate(self.replicates):
            owner[list(group.members)] = s
        return predicted[..., owner, :, :]

    def noise_floor(self, residual: np.ndarray) -> NoiseFloor:
        """The floor from these rollouts' repeats, else from their residual (R, T, C)."""
        beside = self.measured.copy()
        for group in self.replicates:
            own = list(group.members)
            if len(own) > 1 and self.slow[own].all():  # which seldom read at the same moments
                beside[own] = np.where(np.isfinite(self.measured[own]).any(axis=0), self.shown[own], np.nan)
        return noise_floor(self.layout, beside, residual, self.replicates, self.readings)

    @cached_property
    def slow(self) -> np.ndarray:
        """(R,) bool: rollouts that read so seldom that samples between are no measurement."""
        return (np.isfinite(self.shown) & ~np.isfinite(self.measured)).any(axis=(1, 2))

    def repeated(self, number: int) -> np.ndarray:
        """(r, T, C) the repeats of a set as they differ over time, slow ones by the curves through their readings."""
        own = list(self.repeats[number])
        return np.where(self.slow[own, None, None], self.shown[own], self.measured[own])

    @cached_property
    def repeats(self) -> tuple[tuple[int, ...], ...]:
        """Members of each set of replicates that are no copy of another one: only they are repeats."""
        members = [np.array(g.members) for g in self.replicates]
        return tuple(tuple(own[originals(self.measured[own])].tolist()) for own in members)

    def means(self) -> np.ndarray:
        """(S, T, C) mean over the replicates of each set, of those that measured; NaN where none did."""
        return np.stack([mean_of(self.measured[list(own)]) for own in self.repeats])

    def counts(self) -> np.ndarray:
        """(S, T, C) how many replicates of each set measured each sample."""
        return np.stack([np.isfinite(self.measured[list(own)]).sum(axis=0) for own in self.repeats])


def _slow(own: np.ndarray, rate: float) -> bool:
    """Whether stamps lie so far apart that the grid has samples which no reading stands for."""
    return bool(np.median(np.diff(own)) * rate >= SLOW)


def _readings(own: np.ndarray, time: np.ndarray, rate: float) -> np.ndarray:
    """(T,) bool: samples of the grid next to a rollout's own stamps; all where these are about as close as the grid."""
    if not _slow(own, rate):
        return np.ones(len(time), bool)
    at = (own - time[0]) * rate
    near = np.rint(at)
    close = np.abs(at - near) <= NEAR * np.median(np.diff(at))
    return np.isin(np.arange(len(time)), near[close] if close.sum() >= LEAST_SAMPLES else near)


def _known(layout: Layout, own: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(T, C) bool: samples that readings of a rollout stand for: the nearest to a stamp, averages that hold one."""
    if not _slow(own, layout.rate):
        return np.ones((len(time), len(layout.channels)), bool)
    stamped = np.isin(np.arange(len(time)), np.rint((own - time[0]) * layout.rate))
    averaged = {g: window_mean(stamped[:, None].astype(float), layout.samples_in(g))[:, 0] > 0 for g in GROUPS}
    return np.stack([averaged[c.group] for c in layout.channels], axis=-1)


def _useless(m: Measurement, rate: float) -> str:
    """Why a rollout cannot be replayed at a rate (Hz), or ""."""
    if not len(m.commands.time):
        return "has no joint_commands"
    if len(m.time) < LEAST_SAMPLES:
        return f"has only {len(m.time)} samples"
    lasts = min(m.scenario.duration, float(m.time[-1])) - float(m.time[0])
    if lasts * rate < LEAST_SAMPLES - 1:
        return (
            f"lasts only {lasts:.3g} s, {rate * lasts:.1f} samples of its rig's {rate:g} Hz (is the unit of its times "
            "right?)"
        )
    return ""


def _spoilt(layout: Layout, m: Measurement, time: np.ndarray) -> np.ndarray:
    """(T, C) bool: what the gaps of a rollout leave nothing to say about."""
    found = unusable(m, time)
    result = np.where(layout.averaged, found.averages[:, None], found.samples[:, None])
    for i, channel in enumerate(layout.channels):
        if channel.group.name in found.signals:
            result[:, i] |= found.signals[channel.group.name]
    return result


def _asked(measurements: Sequence[Measurement], group: Replicates, duration: float) -> tuple[Scenario, Commands]:
    """What a set of replicates was asked for; jitter of the command times is averaged."""
    members = [measurements[i] for i in group.members]
    first = members[0]
    time = np.mean([m.commands.time for m in members], axis=0)
    scenario = dataclasses.replace(first.scenario, duration=duration, settle=min(first.scenario.settle, SETTLE_S))
    return scenario, dataclasses.replace(first.commands, time=time)
