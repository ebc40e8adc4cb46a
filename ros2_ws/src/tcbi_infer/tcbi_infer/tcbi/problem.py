"""An inference problem: real rollouts, a model, and `simulate`, which turns particles into features.

    problem = Problem.of(model, measurements)
    features = problem.simulate(unit)      # (N, P) in [0, 1] -> Features

The recorded commands are replayed, stamps included, unless the policies that gave them are to act (`loop`).
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.errors import describe
from tcbi_infer.divergence import BINS, Binning, divergence, measured
from tcbi_infer.errors import InferError
from tcbi_infer.seen import used_before
from tcbi_infer.statistics import CALIBRATED, RolloutArrays, Statistic, averaged, select
from tcbi_infer.tcbi.features import Features, Observed, binned, channels_of, divergences, samples
from tcbi_infer.tcbi.loop import AUTO, find_controllers
from tcbi_infer.tcbi.pooled import JS, pooled_divergence
from tcbi_infer.tcbi.prior import FLAT, MODEL, Prior, about
from tcbi_infer.tcbi.rollouts import (
    AVERAGE_S,
    TURNING_S,
    Group,
    blocks_for,
    checked,
    grouped,
    noise_kept,
    noisier,
    noisy_signals,
    sample_rate,
    sensor_noise,
)
from tcbi_infer.tcbi.simulated import as_arrays, with_noise
from tcbi_sim.engine import Controller, simulate
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rig import Noise
from tcbi_sim.rigs import load_rig
from tcbi_sim.workers import chunk_size, present, threads_here

# of a channel: with fewer the histogram of a right model may lie 6 to 11 times as far off as their scatter suggests (a
# simulation of such draws), and be taken for a wrong one; with 5 at most 3 times
LEAST_SAMPLES = 5
CROWDED = 0.9  # share of a channel's samples in one bin, from which it is said
LOOKED_AT = 25  # particles that a thread looks at at a time: with 5 it takes half as long again
CHUNK_VALUES = 2e7  # array elements of a signal bundle held at a time
LONGEST_STEP = 0.005  # s: with 10 ms contacts are softer, and stiff servos look up to an eighth softer or stiffer


@dataclass(frozen=True)
class Problem:
    """Everything that a method needs; immutable, and the same bits for the same particle whoever else is simulated."""

    model: Model
    groups: tuple[Group, ...]
    controllers: tuple[Controller | None, ...]  # one a group; None replays the commands
    statistics: tuple[Statistic, ...]
    observed: Observed
    binnings: tuple[Binning, ...]  # C
    real_samples: tuple[np.ndarray, ...]  # (C) pooled samples of each channel
    blocks: int
    noise: Noise
    timestep: float
    rate: float
    seed: int = 0
    threads: int = 0
    divergence_name: str = JS
    warnings: tuple[str, ...] = field(default_factory=tuple)
    prior: Prior | None = None  # None: flat
    noisy: tuple[str, ...] = ()  # signals that are averaged over `AVERAGE_S`, recorded and simulated alike

    @classmethod
    def of(
        cls,
        model: Model,
        measurements: Sequence[Measurement],
        *,
        statistics: tuple[str, ...] = CALIBRATED,
        divergence_name: str = JS,
        loop: str = AUTO,
        prior: str = FLAT,
        policies: Path | None = None,
        timestep: float | None = None,
        threads: int = 0,
        seed: int = 0,
        bins: int = BINS,
        by_task: bool = True,
    ) -> "Problem":
        """Check the rollouts and prepare them.

        Args:
          model: structure and parameters.
          measurements: the real rollouts.
          statistics: by name; those that the rollouts lack are left out with a warning.
          divergence_name: of `tcbi_infer.divergence`, used by TCBI in both modes.
          loop: as of `find_controllers`.
          prior: "flat" within the parameters' bounds, or "model" to go on from what the model's particles say; these
            rollouts must be new then, since data must not count twice.
          policies: the store's root, where policies are looked for.
          timestep: s of the simulation; 0.005, or one sample interval if that is shorter.
          threads: 0 for all processors.
          seed: of the simulated sensors' noise.
          bins: of each histogram, the two tails among them.
          by_task: whether the method looks at statistics; if not, what is odd in them is not told.

        Raises:
          InferError: the rollouts do not allow an inference.
        """
        divergence(divergence_name)
        usable, warnings = checked(model, measurements)
        if prior not in (FLAT, MODEL):
            raise InferError(describe("prior", prior, f"{FLAT} or {MODEL}"))
        twice = sorted(used_before(model) & {m.rollout_id for m in usable}) if prior == MODEL else []
        if twice:
            raise InferError(
                f"{len(twice)} rollouts, {twice[0]} first, made the distribution of {model.version} already and would "
                "count twice; leave them out, or take the flat prior"
            )
        known, warnings = Prior.of(model) if prior == MODEL else None, [*warnings, *about(model, prior)]
        nominal = load_rig(model.rig).noise
        noise = sensor_noise(usable, nominal)
        noisy = noisy_signals(noise, nominal)
        controllers, said = find_controllers(usable, loop, policies, noisy)
        rate = sample_rate(model, usable, closed_loop=bool(controllers))
        groups = [
            dataclasses.replace(g, arrays=averaged(g.arrays, noisy, AVERAGE_S, TURNING_S))
            for g in grouped(usable, rate, acting=controllers)
        ]
        kept, left_out = _common(statistics, groups)
        parts = [[samples(statistic, g.arrays) for statistic in kept] for g in groups]
        names, owner, pooled = _channels(kept, groups, parts)
        used = [i for i, values in enumerate(pooled) if values.size >= LEAST_SAMPLES]
        if not used:
            raise InferError(
                f"no statistic has {LEAST_SAMPLES} finite samples in the real rollouts (tried: "
                f"{', '.join(s.name for s in kept)}); add another one, or record more or longer rollouts"
            )
        binnings = tuple(Binning.of(pooled[i], bins) for i in used)
        blocks = blocks_for(len(usable))
        counts = _counts(parts, [g.arrays.count for g in groups], used, list(binnings), blocks)[0]
        owner = owner[used]
        present = sorted(set(owner.tolist()))
        observed = Observed(
            counts,
            np.array([present.index(o) for o in owner]),
            tuple(kept[i].name for i in present),
            tuple(names[i] for i in used),
            pooled_divergence(divergence_name, binnings, counts),
        )
        odd = (*left_out, *_silent(names, used), *_constant(names, used, pooled), *_crowded(observed))
        return cls(
            model, tuple(groups), tuple(controllers.get(g.measurements[0].policy_id) for g in groups), kept, observed,
            binnings, tuple(pooled[i] for i in used), blocks, noise,
            timestep or min(LONGEST_STEP, 1 / rate), rate, seed, threads, divergence_name,
            (*warnings, said, *(odd if by_task else ()), *noisier(noise, nominal)),
            known, noisy,
        )  # fmt: skip

    @property
    def rollout_ids(self) -> tuple[str, ...]:
        """Of the real rollouts, in the order of the groups."""
        return tuple(m.rollout_id for g in self.groups for m in g.measurements)

    @property
    def task(self) -> str:
        """The rollouts' tasks, joined by + if they are several."""
        return "+".join(sorted({g.measurements[0].scenario.task for g in self.groups}))

    @property
    def closed_loop(self) -> bool:
        """Whether a policy acts on the simulated robot."""
        return any(c is not None for c in self.controllers)

    @property
    def open_loop(self) -> "Problem":
        """The same with the recorded commands in all rollouts, for particles in the parameters' unit cube."""
        return dataclasses.replace(self, controllers=(None,) * len(self.groups), prior=None)

    @functools.cached_property
    def readings_noise(self) -> Noise:
        """The sensors' noise as far as the real readings keep it on their time grids."""
        kept, n = noise_kept(self.groups), self.noise
        return dataclasses.replace(
            n,
            joint_position=kept * n.joint_position,
            attitude=kept * n.attitude,
            angular_velocity=kept * n.angular_velocity,
            position=kept * n.position,
        )

    def unit(self, cube: np.ndarray) -> np.ndarray:
        """(N, P) where the prior is uniform -> (N, P) in the parameters' unit cube."""
        return cube if self.prior is None else self.prior.unit(cube)

    def simulate(
        self, cube: np.ndarray, progress: Callable[[float], None] | None = None, view: "View | None" = None
    ) -> Any:
        """What a method sees of (N, P) particles in the cube where the prior is uniform; none depends on the others.

        Args:
          cube: (N, P).
          progress: called with the share done.
          view: what is kept of the rollouts; `task_features` by default.
        """
        seen = view or task_features
        unit = self.unit(cube)
        size = sum(len(g.measurements) * len(g.time) for g in self.groups) * (
            len(load_rig(self.model.rig).joint_names) + 20
        )
        steps = sum(len(g.measurements) * len(g.time) for g in self.groups) / (self.rate * self.timestep)
        step = chunk_size(len(unit), steps, max(1, int(CHUNK_VALUES / size)))
        chunks = [unit[begin : begin + step] for begin in range(0, len(unit), step)]
        return _joined(present().map(functools.partial(self.seen, seen), chunks, progress))

    def rollouts(self, unit: np.ndarray) -> tuple[list[RolloutArrays], np.ndarray]:
        """Simulated rollouts of each group, and (N,) whether none of a particle's diverged."""
        exact, valid = self._simulated(unit)
        rngs = self._rngs(unit)
        return [self.read(arrays, rngs) for arrays in exact], valid

    def seen(self, view: "View", unit: np.ndarray) -> Any:
        """What a view keeps of some particles' rollouts: little beside these, which stay where they were simulated."""
        exact, valid = self._simulated(unit)

        def looked(part: slice) -> Any:
            rngs = self._rngs(unit[part])
            return view(self, [self.read(arrays.only(part), rngs) for arrays in exact], valid[part])

        parts = [slice(begin, begin + LOOKED_AT) for begin in range(0, len(unit), LOOKED_AT)]
        with ThreadPoolExecutor(threads_here(self.threads)) as pool:
            return _joined(list(pool.map(looked, parts)))

    def _simulated(self, unit: np.ndarray) -> tuple[list[RolloutArrays], np.ndarray]:
        """As `rollouts`, without the sensors' noise."""
        groups: list[RolloutArrays] = []
        valid = np.ones(len(unit), bool)
        for group, controller in zip(self.groups, self.controllers, strict=True):
            rollouts = simulate(
                self.model,
                self.model.from_unit(unit),
                [m.scenario for m in group.measurements],
                commands=None if controller else [m.commands for m in group.measurements],
                controller=controller,
                noise=self.noise if controller else None,
                timestep=self.timestep,
                rate=self.rate,
                threads=self.threads,
            )
            valid &= ~rollouts.diverged.any(axis=1)
            groups.append(as_arrays(rollouts, group, controller is not None))
        return groups, valid

    def _rngs(self, unit: np.ndarray) -> list[np.random.Generator]:
        """Of each particle's sensors' noise, whoever else is simulated."""
        return [np.random.default_rng([self.seed, zlib.crc32(np.ascontiguousarray(row).tobytes())]) for row in unit]

    def read(self, simulated: RolloutArrays, rngs: Sequence[np.random.Generator]) -> RolloutArrays:
        """Simulated rollouts as the robot's are read: with noise, each particle's of its own, and averaged alike."""
        return averaged(with_noise(simulated, self.readings_noise, rngs), self.noisy, AVERAGE_S, TURNING_S)


def _joined(parts: list[Any]) -> Any:
    """Halves with halves, so that many parts are not copied with every further one."""
    half = len(parts) // 2
    return _joined(parts[:half]).join(_joined(parts[half:])) if half else parts[0]


# What a method keeps of simulated rollouts: one `RolloutArrays` a group, (N,) validity -> something with `join`.
View = Callable[[Problem, list[RolloutArrays], np.ndarray], Any]


def task_features(problem: Problem, rollouts: list[RolloutArrays], valid: np.ndarray) -> Features:
    """The view of TCBI as published: histograms of the task's statistics, and divergences of their samples."""
    parts, used, counts = _binned(problem, rollouts)
    if problem.divergence_name == JS:  # equal to pooling samples, and the counts are there already
        divergence = divergences(problem.observed, counts)
    else:
        pooled = [np.concatenate([v.reshape(len(v), -1) for v in values], axis=1) for values in _by_channel(parts)]
        pairs = zip(problem.real_samples, used, strict=True)
        divergence = np.stack([measured(problem.divergence_name, real, pooled[i]) for real, i in pairs], -1)
    return Features(counts, divergence, _mean_reward(problem.statistics, parts), valid)


def histogram_features(problem: Problem, rollouts: list[RolloutArrays], valid: np.ndarray) -> Features:
    """The view of calibrated TCBI: histograms, and their divergences, which resampled rollouts have, too."""
    parts, _, counts = _binned(problem, rollouts)
    divergence = divergences(problem.observed, counts)
    return Features(counts, divergence, _mean_reward(problem.statistics, parts), valid)


def _binned(problem: Problem, rollouts: list[RolloutArrays]) -> tuple[list[list[np.ndarray]], list[int], np.ndarray]:
    """Samples of each group and statistic, which channels count, and (N, U, C, B) histograms of these."""
    parts = [[samples(statistic, arrays) for statistic in problem.statistics] for arrays in rollouts]
    names, _, _ = _channels(problem.statistics, list(problem.groups), None)
    used = [names.index(name) for name in problem.observed.channels]
    counts = _counts(parts, [arrays.count for arrays in rollouts], used, list(problem.binnings), problem.blocks)
    return parts, used, counts


def _common(names: tuple[str, ...], groups: list[Group]) -> tuple[tuple[Statistic, ...], tuple[str, ...]]:
    """Statistics that every group allows, and a line for each one left out."""
    left_out: dict[str, None] = {}
    for group in groups:
        kept, lines = select(names, group.arrays)
        names = tuple(statistic.name for statistic in kept)
        left_out.update(dict.fromkeys(lines))
    return select(names, groups[0].arrays)[0], tuple(left_out)


def _channels(
    statistics: tuple[Statistic, ...], groups: list[Group], parts: list[list[np.ndarray]] | None
) -> tuple[list[str], np.ndarray, list[np.ndarray]]:
    """Names statistic/channel, each one's statistic, and (if samples are given) its finite samples of all groups."""
    names, owner = [], []
    for i, statistic in enumerate(statistics):
        for channel in channels_of(statistic, groups[0].arrays):
            names.append(f"{statistic.name}/{channel}")
            owner.append(i)
    pooled = []
    if parts is not None:
        flat = [np.concatenate([v.ravel() for v in values]) for values in _by_channel(parts)]
        pooled = [values[np.isfinite(values)] for values in flat]
    return names, np.array(owner), pooled


def _by_channel(parts: list[list[np.ndarray]]) -> list[list[np.ndarray]]:
    """parts[group][statistic] (N, S, C, K) -> for each channel of all statistics, its (N, S, K) of every group."""
    out = []
    for of_groups in zip(*parts, strict=True):
        out += [[values[:, :, c] for values in of_groups] for c in range(of_groups[0].shape[2])]
    return out


def _counts(
    parts: list[list[np.ndarray]], sizes: list[tuple[int, int]], used: list[int], binnings: list[Binning], blocks: int
) -> np.ndarray:
    """(N, U, C, B) float32 counts, the units of all groups in a row."""
    total = sum(s for _, s in sizes) * blocks
    counts = np.empty((sizes[0][0], total, len(used), binnings[0].bins), np.float32)
    channels = _by_channel(parts)
    for c, (index, binning) in enumerate(zip(used, binnings, strict=True)):
        rows = [binned(values[:, :, None], [binning], blocks)[:, :, 0] for values in channels[index]]
        counts[:, :, c] = np.concatenate(rows, axis=1)
    return counts


def _mean_reward(statistics: tuple[Statistic, ...], parts: list[list[np.ndarray]]) -> np.ndarray:
    """(N,) mean reward per control step; NaN where the reward is not among the statistics."""
    index = [i for i, s in enumerate(statistics) if s.name == "reward"]
    if not index:
        return np.full(len(parts[0][0]), np.nan)
    pooled = np.concatenate([p[index[0]].reshape(len(p[index[0]]), -1) for p in parts], axis=1)
    known = np.isfinite(pooled)
    return np.where(known, pooled, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)


def _silent(names: list[str], used: list[int]) -> tuple[str, ...]:
    silent = [name for i, name in enumerate(names) if i not in used]
    return (f"with fewer than {LEAST_SAMPLES} samples, left out: {', '.join(silent)}",) if silent else ()


def _constant(names: list[str], used: list[int], pooled: list[np.ndarray]) -> tuple[str, ...]:
    constant = [f"{names[i]} ({pooled[i][0]:.3g})" for i in used if np.ptp(pooled[i]) == 0]
    return (f"the same in every sample, so it tells little: {', '.join(constant)}",) if constant else ()


def _crowded(observed: Observed) -> tuple[str, ...]:
    counts = observed.counts.sum(axis=0)
    shares = counts.max(axis=-1) / counts.sum(axis=-1)
    found = zip(observed.channels, shares, strict=True)
    crowded = [f"{name} ({share:.1%})" for name, share in found if CROWDED < share < 1]
    line = f"nearly all samples lie in one of {counts.shape[-1]} bins, so it tells little: {', '.join(crowded)}"
    return (line,) if crowded else ()
