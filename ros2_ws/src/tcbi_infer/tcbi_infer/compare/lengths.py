"""Simulations of different lengths in the arrays of one."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Scenario
from tcbi_sim.sensing import Samples


def extended(rollouts: SimulatedRollouts, scenarios: Sequence[Scenario], time: np.ndarray) -> SimulatedRollouts:
    """The same over a longer time (T,), the last sample repeated, as simulations of longer scenarios."""
    duration = np.array([s.duration for s in scenarios])
    index = np.minimum(np.arange(len(time)), len(rollouts.time) - 1)
    longer = _arrays([rollouts], lambda values: values[0][:, :, index])
    return dataclasses.replace(rollouts, scenarios=list(scenarios), time=time, duration=duration, **longer)


def side_by_side(parts: Sequence[SimulatedRollouts], order: np.ndarray) -> SimulatedRollouts:
    """Simulations (N, S) of the same parameters and length, in the given order of their scenarios."""
    times = np.unique(np.concatenate([p.command_time for p in parts]))
    given = []
    for p in parts:
        shape = list(p.commands_given.shape)
        shape[2] = len(times)
        given.append(np.full(shape, np.nan))
        given[-1][:, :, np.searchsorted(times, p.command_time)] = p.commands_given
    scenarios = [s for p in parts for s in p.scenarios]
    return dataclasses.replace(
        parts[0],
        scenarios=[scenarios[s] for s in order],
        command_time=times,
        commands_given=np.concatenate(given, axis=1)[:, order],
        diverged=np.concatenate([p.diverged for p in parts], axis=1)[:, order],
        duration=np.concatenate([p.duration for p in parts])[order],
        **_arrays(parts, lambda values: np.concatenate(values, axis=1)[:, order]),
    )


def _arrays(parts: Sequence[SimulatedRollouts], change: Callable[[list[np.ndarray]], np.ndarray]) -> dict[str, Any]:
    """Each kind of samples that there is, changed."""
    found = {name: [getattr(p, name) for p in parts] for name in Samples.names()}
    return {name: None if values[0] is None else change(values) for name, values in found.items()}
