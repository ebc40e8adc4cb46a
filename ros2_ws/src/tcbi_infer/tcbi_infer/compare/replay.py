"""Recorded commands replayed in the model: predicted channels for many parameter vectors at once."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.clocks import aligned
from tcbi_infer.compare.errors import NothingToCompareError, WrongRigError
from tcbi_infer.compare.replicates import Replicates, find_replicates
from tcbi_infer.compare.signals import Layout
from tcbi_infer.gaps import unusable
from tcbi_sim.engine import SimulatedRollouts, simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

LEAST_SAMPLES = 10


@dataclasses.dataclass(frozen=True)
class Replay:
    """Measurements on a common grid, and what to simulate for them: one simulation for each set of replicates.

    Attributes:
      rig: name of the rig.
      layout: the channels.
      measurements: (R) rollouts, sampled at `time`.
      time: (T,) s.
      measured: (R, T, C) channels, NaN where not measured or after a rollout's end.
      replicates: (S) sets of rollouts that were asked for the same thing.
    """

    rig: str
    layout: Layout
    measurements: tuple[Measurement, ...]
    time: np.ndarray
    measured: np.ndarray
    replicates: tuple[Replicates, ...]
    scenarios: tuple[Scenario, ...]
    commands: tuple[Commands, ...]

    @staticmethod
    def of(model: Model, measurements: Sequence[Measurement], rate: float | None = None) -> "Replay":
        """Prepares rollouts for comparison with a model; lags that only the clocks can have are taken out.

        Raises:
          NothingToCompareError: there are no usable rollouts.
          WrongRigError: a rollout is of another robot.
        """
        usable = [m for m in measurements if not _useless(m)]
        if not usable:
            raise NothingToCompareError({m.rollout_id: _useless(m) for m in measurements})
        rig = load_rig(model.rig)
        for m in usable:
            if m.rig != model.rig or m.joint_names != rig.joint_names:
                raise WrongRigError(model.version, model.rig, m.rig, m.joint_names)
        usable = list(aligned(usable).measurements)
        rate = rate or rig.rate
        layout = Layout.of(usable, rate)
        ends = [min(m.scenario.duration, float(m.time[-1])) for m in usable]
        time = np.arange(1, int(np.floor(max(ends) * rate + 1e-6)) + 1) / rate
        sampled = tuple(m.resampled(time) for m in usable)
        measured = np.stack([layout.extract(m) for m in sampled])
        for r, (m, end) in enumerate(zip(usable, ends, strict=True)):
            measured[r, (time > end + 1e-6) | (time < m.time[0] - 1.0 / rate)] = np.nan
            measured[r, _spoilt(layout, m, time)] = np.nan
        replicates = tuple(find_replicates(usable))
        scenarios, commands = zip(*[_asked(usable, g, float(time[-1])) for g in replicates], strict=True)
        return Replay(model.rig, layout, sampled, time, measured, replicates, scenarios, commands)

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
        """The simulations behind `predict`, with everything that they sense."""
        chosen = range(len(self.replicates)) if sets is None else sets
        return simulate(
            model,
            np.atleast_2d(parameters),
            [self.scenarios[s] for s in chosen],
            commands=[self.commands[s] for s in chosen],
            timestep=timestep,
            rate=self.layout.rate,
        )

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

    def means(self) -> tuple[np.ndarray, np.ndarray]:
        """(S, T, C) mean over the replicates of each set, and (S,) how many they were."""
        mean = np.stack([self.measured[list(g.members)].mean(axis=0) for g in self.replicates])
        return mean, np.array([len(g.members) for g in self.replicates])


def _useless(m: Measurement) -> str:
    """Why a rollout cannot be replayed, or ""."""
    if not len(m.commands.time):
        return "has no joint_commands"
    return f"has only {len(m.time)} samples" if len(m.time) < LEAST_SAMPLES else ""


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
    scenario = dataclasses.replace(first.scenario, duration=duration)
    return scenario, dataclasses.replace(first.commands, time=time)
