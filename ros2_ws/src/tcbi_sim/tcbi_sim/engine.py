"""Many rollouts at once: the one engine under inference, comparison, diagnosis and training.

    model = ModelStore().load("latest")
    out = simulate(model, model.sample(rng, 50), scenarios, commands=recorded)     # open loop, 50 x S
    out = simulate(model, values, scenarios, controller=policy)                     # closed loop at 5 Hz
    out.joint_position                                                              # (N, S, T, J)

Parameters are physical values in the model's order. Results are bit-identical at any number of threads, and wherever
the chunks are worked on (tcbi_sim.workers).
"""

import functools
import itertools
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S, CONTROL_RATE_HZ
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Commands, Measurement, Scenario, observation, progress, roll_pitch_yaw
from tcbi_sim.model import Model
from tcbi_sim.rig import Noise, Rig
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import Samples
from tcbi_sim.simulator import TIMESTEP_S, Simulator, step_for
from tcbi_sim.structure import compile_structure, edited_spec
from tcbi_sim.workers import chunk_size, present

__all__ = ["Controller", "SimulatedRollouts", "Simulator", "compile_structure", "edited_spec", "simulate"]

CHUNK = 512  # simulations at a time: what memory holds, not what threads need
WINDOW = 25  # samples between two looks at the commands in open loop


class Controller(Protocol):
    """A policy or gait, closed loop at the control rate."""

    def reset(self, count: int, rng: np.random.Generator) -> None:
        """Begin `count` episodes."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Targets (B, J) in rad for observations (B, J + 3) at `time` s since the start."""


@dataclass
class SimulatedRollouts:
    """N parameter vectors times S scenarios (N = simulations, S = 1 when paired), T samples each."""

    rig: Rig
    scenarios: list[Scenario]  # S, or N when paired
    time: np.ndarray  # (T,) s
    joint_position: np.ndarray  # (N, S, T, J)
    attitude: np.ndarray | None
    angular_velocity: np.ndarray | None
    linear_acceleration: np.ndarray | None
    contact: np.ndarray | None
    position: np.ndarray | None
    command_time: np.ndarray  # (K,) s of closed loop; of open loop see the commands given
    commands_given: np.ndarray  # (N, S, K, J) rad
    diverged: np.ndarray  # (N, S)
    duration: np.ndarray  # (S,) or (N,) s, where scenarios last differently

    def measurement(self, n: int, s: int = 0, rollout_id: str = "", policy_id: str = "") -> Measurement:
        """One simulated rollout as a measurement, cut to its own duration."""
        scenario = self.scenarios[
            n if len(self.scenarios) == len(self.joint_position) and self.diverged.shape[1] == 1 else s
        ]
        until = np.searchsorted(self.time, scenario.duration + 1e-9)

        def cut(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[n, s, :until]

        position = cut(self.position)
        joint_position = cut(self.joint_position)
        assert joint_position is not None
        given = ~np.isnan(self.commands_given[n, s]).any(axis=1) & (self.command_time < scenario.duration - 1e-9)
        return Measurement(
            rollout_id or f"sim_{n}_{s}",
            self.rig.name,
            scenario,
            policy_id,
            "sim",
            Commands(self.command_time[given], self.commands_given[n, s, given], CONTROL_PERIOD_S),
            self.rig.joint_names,
            self.rig.foot_names,
            self.time[:until],
            joint_position,
            cut(self.attitude),
            cut(self.angular_velocity),
            cut(self.linear_acceleration),
            cut(self.contact),
            position,
            distance=float(progress(position, scenario.initial_yaw)[-1]) if position is not None else np.nan,
        )


def simulate(
    model: Model,
    parameters: np.ndarray,
    scenarios: Sequence[Scenario],
    *,
    commands: Sequence[Commands] | None = None,
    controller: Controller | None = None,
    noise: Noise | None = None,
    pairing: str = "product",
    timestep: float = TIMESTEP_S,
    rate: float | None = None,
    threads: int = 0,
    chunk: int = CHUNK,
    progress: Callable[[float], None] | None = None,
    solver: Mapping[str, Any] | None = None,
) -> SimulatedRollouts:
    """Roll out every parameter vector on every scenario.

    Args:
      model: rig, effects, order of parameters.
      parameters: (N, P).
      scenarios: S of them; N with pairing "zip".
      commands: open loop, one per scenario.
      controller: closed loop at 5 Hz. Exactly one of the two.
      noise: of the sensors that the controller reads; it reads them perfectly by default. What is returned has none.
      pairing: "product", or "zip" to run parameters[i] on scenarios[i], which gives arrays (N, 1, ...).
      timestep: s at most; the longest one up to it that divides the sample interval is taken.
      rate: samples a second; the rig's own by default.
      threads: 0 for all processors.
      chunk: simulations held in memory at a time; open loop and stateless controllers do not depend on it.
      progress: called with the share done.
      solver: MuJoCo's options in place of the rig's, by name: `integrator`, `cone`, `impratio`.

    Raises:
      SimError: shapes that do not fit, a time step of 0 or less, or neither or both of commands and controller.
    """
    if (commands is None) == (controller is None):
        raise SimError("simulate needs either commands (open loop) or a controller (closed loop)")
    if pairing not in ("product", "zip"):
        raise SimError(f"pairing {pairing!r}, allowed is product or zip")
    parameters = np.atleast_2d(np.asarray(parameters, float))
    n, s = len(parameters), len(scenarios)
    if pairing == "zip" and n != s:
        raise SimError(f"pairing zip needs as many scenarios as parameter vectors, got {s} and {n}")
    if commands is not None and len(commands) != s:
        raise SimError(f"{s} scenarios need {s} command sequences, got {len(commands)}")
    rows, columns = (np.arange(n), np.arange(n)) if pairing == "zip" else map(np.ravel, np.indices((n, s)))
    timestep = step_for(rate or load_rig(model.rig).rate, timestep)
    repeats = _repeats(scenarios)
    size = chunk if controller is not None else _chunk_size(scenarios, len(rows), timestep, chunk)
    chunks = [
        Chunk(
            begin,
            parameters[rows[begin : begin + size]],
            [scenarios[c] for c in columns[begin : begin + size]],
            None if commands is None else [commands[c] for c in columns[begin : begin + size]],
            [repeats[c] for c in columns[begin : begin + size]],
        )
        for begin in range(0, len(rows), size)
    ]
    work = functools.partial(_simulated, model, controller, noise, timestep, threads, rate, solver)
    parts = present().map(work, chunks, progress)
    return _gather(load_rig(model.rig), list(scenarios), parts, (n, 1) if pairing == "zip" else (n, s))


Part = tuple[Samples, np.ndarray, np.ndarray, np.ndarray]  # samples, command times, commands, diverged


class Chunk(NamedTuple):
    """Simulations that are worked on together."""

    offset: int  # of the first one in its call
    parameters: np.ndarray
    scenarios: list[Scenario]
    commands: list[Commands] | None
    repeats: Sequence[int] = ()  # see `_repeats`; without, each scenario is taken for the first of its seed


def _repeats(scenarios: Sequence[Scenario]) -> list[int]:
    """(S,) how many scenarios before each one in the call have its seed: recordings may all have the same."""
    met: dict[int, int] = {}
    found = []
    for scenario in scenarios:
        found.append(met.get(scenario.seed, 0))
        met[scenario.seed] = found[-1] + 1
    return found


def _chunk_size(scenarios: Sequence[Scenario], count: int, timestep: float, most: int) -> int:
    """Simulations in a chunk of open loop: as they suit the workers, where none has to wait for another one's end."""
    if len({(s.duration, s.settle) for s in scenarios}) > 1:
        return most
    return chunk_size(count, sum((s.duration + s.settle) / timestep for s in scenarios[:1]), most)


def _simulated(
    model: Model,
    controller: Controller | None,
    noise: Noise | None,
    timestep: float,
    threads: int,
    rate: float | None,
    solver: Mapping[str, Any] | None,
    chunk: Chunk,
) -> Part:
    """What a chunk's simulations do; of the others in the call it knows nothing."""
    threads = present().threads or threads
    simulator = Simulator(model, chunk.parameters, chunk.scenarios, timestep, threads, rate, solver, chunk.repeats)
    if controller is not None:
        return _closed_loop(simulator, controller, noise, chunk)
    assert chunk.commands is not None
    return _open_loop(simulator, chunk.commands)


def _closed_loop(simulator: Simulator, controller: Controller, noise: Noise | None, chunk: Chunk) -> Part:
    duration = max(s.duration for s in simulator.scenarios)
    controller.reset(simulator.count, np.random.default_rng([chunk.offset, simulator.scenarios[0].seed]))
    parts, given, now = [simulator.observe()], [], _attitude(simulator.observe())
    yaw0 = roll_pitch_yaw(now)[:, 2]
    times = np.arange(np.ceil(duration * CONTROL_RATE_HZ - 1e-6)) / CONTROL_RATE_HZ  # a recording may end between ticks
    misread = _misreadings(simulator, noise, len(times), chunk.repeats) if noise else None
    for k, t in enumerate(times):
        last = parts[-1]
        seen = observation(last.joint_position[:, -1], _attitude(last), yaw0)
        if misread is not None:
            seen = seen + misread[:, k]
        target = np.asarray(controller.act(float(t), seen), float)
        simulator.command(target)
        given.append(target)
        parts.append(simulator.advance(CONTROL_PERIOD_S))
    return Samples.concatenate(parts), times, np.stack(given, axis=1), simulator.diverged.copy()


def _misreadings(simulator: Simulator, noise: Noise, ticks: int, repeats: Sequence[int]) -> np.ndarray:
    """(B, ticks, J + 3) white noise of the sensors on what a policy sees (the paper's equation 14), in rad.

    Each simulation has its own, whatever scenarios of other seeds are simulated with it.
    """
    joints = len(simulator.rig.joint_names)
    # an encoder's steps are as good as noise evenly spread over one of them
    angle = np.hypot(noise.joint_position, noise.encoder_step / np.sqrt(12))
    sd = np.r_[np.full(joints, angle), np.full(3, noise.attitude)]
    keys = [
        [zlib.crc32(np.ascontiguousarray(row).tobytes()), scenario.seed, 14, repeat]
        for row, scenario, repeat in zip(simulator.parameters, simulator.scenarios, repeats, strict=True)
    ]
    return sd * np.stack([np.random.default_rng(key).standard_normal((ticks, joints + 3)) for key in keys])


def _attitude(samples: Samples) -> np.ndarray:
    """Attitude of the last sample, (B, 4); level where the rig has no IMU."""
    if samples.attitude is None:
        return np.tile([1.0, 0.0, 0.0, 0.0], (len(samples.joint_position), 1))
    return samples.attitude[:, -1]


def _open_loop(simulator: Simulator, commands: list[Commands]) -> Part:
    """Replay each simulation's own commands; they act at their own times, not on the sample grid."""
    duration = max(s.duration for s in simulator.scenarios)
    samples = int(np.floor(duration * simulator.rate + 1e-6))
    times = np.unique(np.concatenate([c.time for c in commands]))
    times = times[times < duration]
    joints = len(simulator.rig.joint_names)
    table = np.full((len(times), simulator.count, joints), np.nan)
    power = np.zeros((len(times), simulator.count), np.int8)  # 1 or -1 where it is switched on or off
    for b, c in enumerate(commands):
        inside = c.time < duration
        rows = np.searchsorted(times, c.time[inside])
        table[rows, b] = c.target[inside]
        if c.torque_on is not None:
            on = np.where(c.torque_on[inside], 1, -1)
            power[rows, b] = np.where(np.diff(on, prepend=1) != 0, on, 0)
    ramps = np.array([[c.ramp] for c in commands])
    parts, next_command, powered = [simulator.observe()], 0, np.ones(simulator.count, bool)
    switched = np.floor(times[power.any(axis=1)] * simulator.rate + 1e-9).astype(int)
    windows = np.unique(np.r_[np.arange(0, samples, WINDOW), switched, samples])
    for k, last in itertools.pairwise(windows):
        end = last / simulator.rate
        while next_command < len(times) and times[next_command] < end - 1e-9:
            simulator.path.give(float(times[next_command]), table[next_command], ramps)
            powered = np.where(power[next_command] == 0, powered, power[next_command] > 0)
            next_command += 1
        simulator.set_torque(powered)
        parts.append(simulator.advance(end - k / simulator.rate))
    return Samples.concatenate(parts), times, table.transpose(1, 0, 2), simulator.diverged.copy()


def _gather(rig: Rig, scenarios: list[Scenario], parts: list[Part], shape: tuple[int, int]) -> SimulatedRollouts:
    length = max(len(p[0].time) for p in parts)

    def join(name: str) -> np.ndarray | None:
        if getattr(parts[0][0], name) is None:
            return None
        rows = [_extended(getattr(p[0], name), length) for p in parts]
        joined = np.concatenate(rows)
        return joined.reshape(*shape, *joined.shape[1:])

    arrays: dict[str, Any] = {name: join(name) for name in Samples.names()}
    longest = max(parts, key=lambda p: len(p[0].time))
    if any(not np.array_equal(p[1], longest[1]) for p in parts):
        times = np.unique(np.concatenate([p[1] for p in parts]))
    else:
        times = longest[1]
    given = np.full((sum(len(p[2]) for p in parts), len(times), parts[0][2].shape[2]), np.nan)
    row = 0
    for _, own, values, _ in parts:
        given[row : row + len(values), np.searchsorted(times, own)] = values
        row += len(values)
    return SimulatedRollouts(
        rig,
        scenarios,
        longest[0].time,
        **arrays,
        command_time=times,
        commands_given=given.reshape(*shape, *given.shape[1:]),
        diverged=np.concatenate([p[3] for p in parts]).reshape(shape),
        duration=np.array([s.duration for s in scenarios]),
    )


def _extended(values: np.ndarray, length: int) -> np.ndarray:
    missing = length - values.shape[1]
    return values if missing <= 0 else np.concatenate([values, np.repeat(values[:, -1:], missing, axis=1)], axis=1)
