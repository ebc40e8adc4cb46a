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
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.errors import describe
from tcbi_contract.wording import some
from tcbi_infer.compare.timestep import USUAL_STEP
from tcbi_infer.divergence import BINS, Binning, divergence, measured
from tcbi_infer.errors import InferError
from tcbi_infer.seen import used_before
from tcbi_infer.statistics import CALIBRATED, RolloutArrays, Statistic, averaged, samples, select
from tcbi_infer.tcbi.channels import LEAST_SAMPLES, by_channel, counted, mean_reward, names_of, oddities, pooled
from tcbi_infer.tcbi.features import Features, Observed, divergences
from tcbi_infer.tcbi.in_time import Differences, comparable, differences
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

LOOKED_AT = 13  # particles that a thread looks at at a time: 5 take half as long again, 25 need new memory each time
CHUNK_VALUES = 2e7  # array elements of a signal bundle held at a time
LONGEST_STEP = 0.005  # s: with 10 ms contacts are softer, and stiff servos look up to an eighth softer or stiffer


@dataclass(frozen=True)
class Problem:
    """Everything that a method needs; immutable, and the same bits for the same particle whoever else is simulated."""

    model: Model
    groups: tuple[Group, ...]
    controllers: tuple[Controller | None, ...]  # one a group; None replays the commands
    statistics: tuple[Statistic, ...]  # of which there are histograms
    followed: tuple[Statistic, ...]  # that are compared in time
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
    short_step: float | None = None  # s, to which motions are corrected: the one with which models are compared
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
          timestep: s of the simulation, whose parameters are inferred then; None for 0.005, or one sample interval if
            that is shorter, with motions corrected to 0.002.
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
        blocks = blocks_for(len(usable))
        acting = tuple(controllers.get(g.measurements[0].policy_id) for g in groups)
        followed, in_time, not_followed = comparable(
            [s for s in kept if s.in_time], [g.recorded for g in groups], [c is None for c in acting], blocks
        )
        if all(s.in_time for s in kept):
            raise InferError(
                f"{some([s.name for s in kept])}: compared in time alone, which says nothing where a policy acts; name "
                "a statistic with a distribution, too, such as joint_tracking"
            )
        kept = tuple(s for s in kept if not s.in_time)
        parts = [[samples(statistic, g.arrays) for statistic in kept] for g in groups]
        (names, owner), values = names_of(kept, groups[0].arrays), pooled(parts)
        used = [i for i, found in enumerate(values) if found.size >= LEAST_SAMPLES]
        if not used:
            raise InferError(
                f"no statistic has {LEAST_SAMPLES} finite samples in the real rollouts (tried: "
                f"{', '.join(s.name for s in kept)}); add another one, or record more or longer rollouts"
            )
        binnings = tuple(Binning.of(values[i], bins) for i in used)
        counts = counted(parts, [g.arrays.count for g in groups], used, list(binnings), blocks)[0]
        owner = owner[used]
        present = sorted(set(owner.tolist()))
        observed = Observed(  # line 1 of Algorithm 1
            counts,
            np.array([*(present.index(o) for o in owner), *(len(present) + k for k in range(len(followed)))]),
            (*(kept[i].name for i in present), *(s.name for s in followed)),
            (*(names[i] for i in used), *(f"{s.name}/in time" for s in followed)),
            pooled_divergence(divergence_name, binnings, counts),
            in_time,
        )
        odd = (*left_out, *not_followed, *oddities(names, used, values, observed))
        step = timestep or min(LONGEST_STEP, 1 / rate)
        return cls(
            model, tuple(groups), acting, kept, followed, observed,
            binnings, tuple(values[i] for i in used), blocks, noise,
            step, rate, seed, threads, divergence_name,
            (*warnings, said, *(odd if by_task else ()), *noisier(noise, nominal)),
            known, USUAL_STEP if timestep is None and step > USUAL_STEP else None, noisy,
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

    @property
    def finer(self) -> "Problem | None":
        """The same with the short steps to which motions are corrected, if they are."""
        if self.short_step is None:
            return None
        return dataclasses.replace(self, timestep=self.short_step, short_step=None)

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

    def rollouts(self, unit: np.ndarray) -> "Simulated":
        """Of some particles."""
        return self._read(*self._simulated(unit), unit)

    def seen(self, view: "View", unit: np.ndarray) -> Any:
        """What a view keeps of some particles' rollouts: little beside these, which stay where they were simulated."""
        exact, valid = self._simulated(unit)

        def looked(part: slice) -> Any:
            return view(self, self._read([arrays.only(part) for arrays in exact], valid[part], unit[part]))

        parts = [slice(begin, begin + LOOKED_AT) for begin in range(0, len(unit), LOOKED_AT)]
        with ThreadPoolExecutor(threads_here(self.threads)) as pool:
            return _joined(list(pool.map(looked, parts)))

    def _read(self, exact: list[RolloutArrays], valid: np.ndarray, unit: np.ndarray) -> "Simulated":
        rngs = self._rngs(unit)
        return Simulated([self.read(arrays, rngs) for arrays in exact], exact, valid)

    def _simulated(self, unit: np.ndarray) -> tuple[list[RolloutArrays], np.ndarray]:
        """Rollouts of each group without the sensors' noise, and (N,) whether none of a particle's diverged."""
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


class Simulated(NamedTuple):
    """Rollouts of N particles, one `RolloutArrays` a group, on the grids of the real ones."""

    readings: list[RolloutArrays]  # as the robot's are read
    exact: list[RolloutArrays]  # without the sensors' noise, and not averaged
    valid: np.ndarray  # (N,) bool, whether none of a particle's diverged


def _joined(parts: list[Any]) -> Any:
    """Halves with halves, so that many parts are not copied with every further one."""
    half = len(parts) // 2
    return _joined(parts[:half]).join(_joined(parts[half:])) if half else parts[0]


# What a method keeps of simulated rollouts: something with `join`.
View = Callable[[Problem, Simulated], Any]


def task_features(problem: Problem, simulated: Simulated) -> Features:
    """The view of TCBI as published: histograms of the task's statistics, and divergences of their samples."""
    parts, used, counts = _binned(problem, simulated.readings)
    if problem.divergence_name == JS:  # equal to pooling samples, and the counts are there already
        divergence = divergences(problem.observed, counts)
    else:
        every = [np.concatenate([v.reshape(len(v), -1) for v in values], axis=1) for values in by_channel(parts)]
        pairs = zip(problem.real_samples, used, strict=True)
        divergence = np.stack([measured(problem.divergence_name, real, every[i]) for real, i in pairs], -1)
    return _features(problem, simulated, parts, counts, divergence)


def histogram_features(problem: Problem, simulated: Simulated) -> Features:
    """The view of calibrated TCBI: histograms, and their divergences, which resampled rollouts have, too."""
    parts, _, counts = _binned(problem, simulated.readings)
    return _features(problem, simulated, parts, counts, divergences(problem.observed, counts))


def differences_of(problem: Problem, simulated: Simulated) -> Differences:
    """What simulations differ by from the robot in what is compared in time."""
    return differences(
        problem.followed,
        [g.recorded for g in problem.groups],
        simulated.exact,
        [c is None for c in problem.controllers],
        problem.blocks,
    )


def _features(
    problem: Problem, simulated: Simulated, parts: list[list[np.ndarray]], counts: np.ndarray, divergence: np.ndarray
) -> Features:
    """What is compared in time goes behind the histograms' divergences."""
    found = differences_of(problem, simulated)
    divergence = np.concatenate([divergence, problem.observed.in_time.divergences(found)], axis=1)
    return Features(counts, divergence, mean_reward(problem.statistics, parts), simulated.valid, found)


def _binned(problem: Problem, rollouts: list[RolloutArrays]) -> tuple[list[list[np.ndarray]], list[int], np.ndarray]:
    """Samples of each group and statistic, which channels count, and (N, U, C, B) histograms of these."""
    parts = [[samples(statistic, arrays) for statistic in problem.statistics] for arrays in rollouts]
    names, _ = names_of(problem.statistics, problem.groups[0].arrays)
    used = [names.index(name) for name in problem.observed.channels[: len(problem.binnings)]]
    counts = counted(parts, [arrays.count for arrays in rollouts], used, list(problem.binnings), problem.blocks)
    return parts, used, counts


def _common(names: tuple[str, ...], groups: list[Group]) -> tuple[tuple[Statistic, ...], tuple[str, ...]]:
    """Statistics that every group allows, and a line for each one left out."""
    left_out: dict[str, None] = {}
    for group in groups:
        kept, lines = select(names, group.arrays)
        names = tuple(statistic.name for statistic in kept)
        left_out.update(dict.fromkeys(lines))
    return select(names, groups[0].arrays)[0], tuple(left_out)
