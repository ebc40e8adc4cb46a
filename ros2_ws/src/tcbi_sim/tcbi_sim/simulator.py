"""Simulations of one model structure, stepped together: the live sim node is one, training environments are hundreds.

    simulator = Simulator(model, model.sample(rng, 64), scenarios, timestep=0.01)
    simulator.command(targets)                  # (64, J) rad, on a linear ramp
    samples = simulator.advance(0.2)            # readings at the sample rate, (64, 10, ...)

Results are bit-identical at any number of threads. A simulation that diverges is marked in `diverged`, keeps its last
values, and never stops the others.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_sim.command_path import CommandPath
from tcbi_sim.effect import State
from tcbi_sim.errors import SimError
from tcbi_sim.fields import Fields
from tcbi_sim.measurement import Scenario, quaternion_from_rpy
from tcbi_sim.model import Model
from tcbi_sim.power import ServoPower
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import Samples, delay, multiply, rotate_back, sense
from tcbi_sim.sensor_data import SensorData
from tcbi_sim.structure import compile_structure, silence_mujoco
from tcbi_sim.terrain import write_terrain

TIMESTEP_S = 0.002  # at most, where none is asked for
CLEARANCE = 0.004  # m above the ground before settling
SETTLE_STRETCH = 2.5  # times the time step while settling: a posture at rest hardly depends on it
SETTLE_STEP_S = 0.005  # but no longer than this
SETTLE_LAST_S = 0.1  # at the time step itself: contacts are softer over a longer one
MEMORY_S = 0.3  # s of samples kept for late sensors
SURELY = 1e-6  # of a time step: a command that comes when a step begins acts in it, whatever the last bits say

silence_mujoco()


def step_for(rate: float, at_most: float = TIMESTEP_S) -> float:
    """The longest time step (s) up to a limit that divides the sample interval of a rate (Hz).

    Raises:
      SimError: the limit is 0 or less.
    """
    if not at_most > 0:
        raise SimError(f"timestep {at_most} s, allowed is more than 0")
    return 1 / (rate * max(1, math.ceil(1 / (rate * at_most) - 1e-6)))


class Simulator:
    """B simulations of one model structure. The live sim node is B = 1; training environments are hundreds."""

    def __init__(
        self,
        model: Model,
        parameters: np.ndarray,
        scenarios: Sequence[Scenario],
        timestep: float | None = None,
        threads: int = 0,
        rate: float | None = None,
        solver: Mapping[str, Any] | None = None,
        repeats: Sequence[int] = (),
    ):
        """Stand every simulation at its scenario's start.

        Args:
          model: gives rig, effects and the order of parameters.
          parameters: (B, P) physical values.
          scenarios: B of them.
          timestep: s; must divide the sample interval. By default the longest one up to `TIMESTEP_S` that does.
          threads: 0 for all processors.
          rate: samples a second; the rig's own by default.
          solver: MuJoCo's options in place of the rig's, by name: `integrator`, `cone`, `impratio`.
          repeats: B numbers that tell scenarios of one seed apart; none are all 0. A seed and its number say which
            commands a simulation loses.
        """
        self.rig, self.uses, self._names = load_rig(model.rig), model.uses(), model.names
        self._joint_gains, self._fixed = model.joint_gains, model.fixed
        self.rate = rate or self.rig.rate
        self.timestep = timestep = step_for(self.rate) if timestep is None else timestep
        self.per_sample = round(1 / (self.rate * timestep))
        if abs(self.per_sample * self.rate * timestep - 1) > 1e-6 or self.per_sample < 1:
            raise SimError(
                f"timestep {timestep} s does not divide the sample interval {1 / self.rate:.9g} s, allowed is that "
                f"interval over a whole number, such as {step_for(self.rate, timestep):.9g} s"
            )
        self.scenarios = list(scenarios)
        self.parameters = np.array(parameters, float)
        self._check_shapes()
        self._repeats = np.zeros(len(self.scenarios), int)
        self._repeats[:] = list(repeats) or 0
        self._blocks = max((len(s.blocks) for s in scenarios), default=0)
        self._mj = compile_structure(self.rig, self.uses, self._blocks)
        self._mj.opt.timestep = timestep
        for name, value in (solver or {}).items():
            setattr(self._mj.opt, name, value)
        self.count = len(self.scenarios)
        self._batch = Batch(self._mj, self.count, threads)
        self._step = self._batch.expand("opt.timestep")
        self.fields = Fields.perfect(self._mj, self._batch, self.count, self.rig.joint_names)
        self.path = CommandPath(self.fields.command, [np.random.default_rng(0)] * self.count)
        self._taken = 0  # samples so far: times are counted, never added up
        self._torque_on = np.ones(self.count, bool)
        self.diverged, self._warned = np.zeros(self.count, bool), np.zeros(self.count, int)
        self._drifting = [u for u in self.uses if u.effect.update]
        self._index()
        self.reset()

    @property
    def time(self) -> float:
        """Simulator time in s; it goes on over resets."""
        return self._taken / self.rate

    @property
    def mj(self) -> mujoco.MjModel:
        """The compiled structure at nominal parameters; `materialise` gives one simulation's own."""
        return self._mj

    def materialise(self, index: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One simulation's model and state, to render it or to pass it to any MuJoCo function."""
        model = self._batch.get_model(index)
        data = self._batch.get_data(index)
        mujoco.mj_forward(model, data)
        return model, data

    def reset(
        self,
        ids: np.ndarray | None = None,
        parameters: np.ndarray | None = None,
        scenarios: Sequence[Scenario] | None = None,
        rewind: bool = False,
        repeats: Sequence[int] = (),
    ) -> None:
        """Put simulations at the start of an episode, settled in their initial posture. Time goes on, or is rewound.

        Args:
          ids: (n,) which; None for all.
          parameters: (n, P) new values; None to keep them.
          scenarios: n new ones; None to keep them. At most as many blocks as when the simulator was made.
          rewind: time starts at 0 again, so that the episode has the same bits as in a new simulator; for all of them.
          repeats: n of the new scenarios, as when the simulator was made; without new scenarios the old ones stay.
        """
        if rewind and ids is not None:
            raise SimError("time is one for all simulations: rewind it only where all of them begin anew (ids=None)")
        self._taken = 0 if rewind else self._taken
        ids = np.arange(self.count) if ids is None else np.asarray(ids)
        if parameters is not None:
            self.parameters[ids] = parameters
        for i, scenario in zip(ids, scenarios or (), strict=scenarios is not None):
            if len(scenario.blocks) > self._blocks:
                raise SimError(
                    f"the scenario has {len(scenario.blocks)} blocks, this simulator has room for {self._blocks}"
                )
            self.scenarios[i] = scenario
        if scenarios is not None:
            self._repeats[ids] = list(repeats) or 0
        self._check_shapes()
        self._write_fields(ids)
        self._place(ids)
        self.diverged[ids] = False
        self._warned[ids] = self._warnings()[ids]
        self._settle(ids)
        self._raw: Samples | None = None
        self._remember(self._sample_now())

    def command(self, target: np.ndarray, ramp: float = CONTROL_PERIOD_S, torque_on: np.ndarray | None = None) -> None:
        """Send targets (B, J) now; a row of NaN is no command for that simulation.

        Args:
          target: rad (or N m for a torque rig).
          ramp: s to reach it.
          torque_on: (B,) whether the servos hold at all; None to leave it.
        """
        if torque_on is not None:
            self.set_torque(torque_on)
        self.path.give(self.time, np.broadcast_to(np.asarray(target, float), self._hold.shape), ramp)

    def set_torque(self, on: np.ndarray | bool) -> None:
        """Switch all servos of each simulation on or off (limp), (B,)."""
        on = np.broadcast_to(on, (self.count,))
        if np.array_equal(on, self._torque_on):
            return
        self._torque_on = np.array(on)
        self._power.write(self._torque_on)

    def advance(self, duration: float, forces: bool = True) -> Samples:
        """Step on and return the sensors' readings at the sample rate, the last one at the new time.

        Args:
          duration: s, a multiple of the sample interval.
          forces: whether acceleration and contacts of the last reading are needed; else they may be those of a time
            step before, which saves solving for the contacts once more.
        """
        samples = round(duration * self.rate)
        if samples < 1 or abs(samples - duration * self.rate) > 1e-6:
            raise SimError(f"can advance by multiples of {1 / self.rate} s, got {duration} s")
        control = self._control(samples)
        if not self._drifting:
            return self._readings(self._advance(control, forces or self._signals.need_forces))
        parts = []
        for each in np.split(control, samples, axis=1):
            state = self._state()
            for use in self._drifting:
                use.update(self.fields, self.rig, self._row(), state, 1 / self.rate)
            if self._power.is_stale:
                self._power.write(self._torque_on)
            parts.append(self._advance(each))
        return self._readings(Samples.concatenate(parts))

    def observe(self) -> Samples:
        """The sensors' readings at the present time, (B, 1, ...)."""
        assert self._raw is not None
        return self._readings(self.unsensed(1), self._raw.time[-1:])

    def unsensed(self, count: int) -> Samples:
        """The true signals at the times of the latest `count` readings, (B, count, ...), of one `advance` at most."""
        assert self._raw is not None
        return dataclasses.replace(self._raw.map(lambda v: v[:, -count:]), time=self._raw.time[-count:])

    # -- inside ---------------------------------------------------------------------------------------------------

    def _check_shapes(self) -> None:
        expected = (len(self.scenarios), len(self._names))
        if self.parameters.shape != expected:
            raise SimError(
                f"parameters have shape {self.parameters.shape}, expected {expected} for {', '.join(self._names)}"
            )

    def _index(self) -> None:
        self._actuators = self.fields.actuators()
        self._qpos = np.array([self._mj.joint(j).qposadr[0] for j in self.rig.joint_names])
        self._dofs = self.fields.dofs()
        self._power = ServoPower(self.fields, self._actuators, self._dofs)
        self._signals = SensorData(self._mj, self.rig)
        self._hold = np.zeros((self.count, len(self.rig.joint_names)))
        # bound once, before any call: a field bound later would read zero until the call after
        self._sensordata = self._batch.bind("sensordata")
        self._geom_xpos = self._batch.bind("geom_xpos")
        self._actuator_force = self._batch.bind("actuator_force")

    def _row(self) -> dict[str, np.ndarray]:
        fixed = {name: np.full(self.count, value) for name, value in self._fixed.items()}
        return fixed | dict(zip(self._names, self.parameters.T, strict=True))

    def _write_fields(self, ids: np.ndarray) -> None:
        """Write every simulation's fields anew; those not in `ids` get the values that they have."""
        f, row = self.fields, self._row()
        f.model.restore()
        for group in (f.command, f.sensing):
            for name, values in vars(group).items():
                values[...] = np.inf if name == "speed" else 0.0
        f.powered_damping[...] = f.compliance[...] = 0.0
        f.strength[...] = 1.0
        f.begins[...] = False
        f.begins[ids] = True
        if self.rig.floating:
            write_terrain(self.fields, self._mj, self.scenarios)
        keys = sorted({k for s in self.scenarios for k, _ in s.constants})
        constants = {k: np.array([s.constant(k, np.nan) for s in self.scenarios]) for k in keys}
        self.rig.apply(f, {p.name: row[p.name] for p in self.rig.parameters}, constants)
        if self._joint_gains:
            f.scale_gain(f.actuators(), np.array([self._joint_gains]))
        for use in self.uses:
            use.apply(f, self.rig, row)
        self._torque_on[ids] = True
        self._power.begin()
        self._power.write(self._torque_on)
        if f.model.needs_constants:
            self._batch.set_const(ids)

    def _place(self, ids: np.ndarray) -> None:
        """Initial state: posture, and for a floating rig the trunk just above the ground, aligned with it."""
        self._batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        qpos, qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        for i in ids:
            posture, velocity = self.scenarios[i].initial_joint_position, self.scenarios[i].initial_joint_velocity
            self._hold[i] = self.rig.at_rest if posture is None else np.asarray(posture)
            if velocity is not None:
                qvel[i, self._dofs] = velocity
        # where a servo is mounted off its zero, the link stands off by as much
        qpos[np.ix_(ids, self._qpos)] = self._hold[ids] + self.fields.command.offset[ids]
        held = self._hold[ids] if self.rig.kind == "position" else np.zeros_like(self._hold[ids])
        self.path.hold(ids, held, [self._losses(i) for i in ids])
        self._batch.bind("ctrl")[np.ix_(ids, self._actuators)] = held + self.fields.command.offset[ids]
        if self.rig.floating:
            self._stand(ids, qpos)

    def _losses(self, index: int) -> np.random.Generator:
        """What decides which commands of a simulation get lost."""
        seed, repeat = self.scenarios[index].seed, int(self._repeats[index])
        return np.random.default_rng([seed, 7919, repeat] if repeat else [seed, 7919])

    def _stand(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        ground = self.fields.model["body_quat"][ids, self.fields.body("ground")]
        yaw = np.array([self.scenarios[i].initial_yaw for i in ids])
        zero = np.zeros_like(yaw)
        qpos[ids, 3:7] = multiply(ground, quaternion_from_rpy(zero, zero, yaw))
        qpos[ids, :3] = 0.0
        self._batch.forward(ids, int(mujoco.mjtStage.mjSTAGE_POS))
        normal = rotate_back(ground * [1, -1, -1, -1], np.broadcast_to([0.0, 0.0, 1.0], (len(ids), 3)))
        feet = [self._mj.geom(foot).id for foot in self.rig.foot_geoms]
        height = np.einsum("bfx,bx->bf", self._geom_xpos[np.ix_(ids, feet)], normal)
        lowest = (height - self._mj.geom_size[feet, 0]).min(axis=1)
        qpos[ids, :3] = normal * (CLEARANCE - lowest)[:, None]

    def _settle(self, ids: np.ndarray) -> None:
        longest = max(self.scenarios[i].settle for i in ids)
        if not self.rig.floating or not longest:
            return
        long = max(self.timestep, min(SETTLE_STRETCH * self.timestep, SETTLE_STEP_S))
        last = min(longest, SETTLE_LAST_S)
        for step, duration in ((long, longest - last), (self.timestep, last)):
            self._step[ids] = step
            if steps := round(duration / step):
                self._run(functools.partial(self._batch.step, ids, steps))

    def _run(self, call: Callable[[], object]) -> np.ndarray:
        """Returns which simulations MuJoCo gave up in the call; they stay as they were, and have diverged."""
        try:
            call()
        except SimulationError as e:
            self.diverged[e.ids] = True
            return np.asarray(e.ids, int)
        return np.zeros(0, int)

    def _control(self, samples: int) -> np.ndarray:
        """(B, steps, actuators) what the servos track in the next samples."""
        steps = samples * self.per_sample
        begins = (self._taken * self.per_sample + np.arange(steps) + SURELY) * self.timestep
        control = np.zeros((self.count, steps, self._mj.nu))
        control[:, :, self._actuators] = self.path.references(begins, self.timestep)
        return control

    def _advance(self, control: np.ndarray, forces: bool = True) -> Samples:
        """Step through (B, steps, actuators), whole samples, and return the true signals of the new samples."""
        steps = control.shape[1]
        samples = steps // self.per_sample
        stage = mujoco.mjtStage.mjSTAGE_ACC if forces else mujoco.mjtStage.mjSTAGE_VEL
        if samples == 1:
            self._run(lambda: self._batch.rollout(steps, control))
            self._taken += 1
            return self._sample_now(stage)
        recorded = np.empty((self.count, steps, self._sensordata.shape[-1]))  # whole where another simulation raises
        out = {"sensordata": recorded}
        failed = self._run(lambda: self._batch.rollout(steps, control, record=("sensordata",), out=out))
        recorded[failed] = self._sensordata[failed, None]
        times = (self._taken + np.arange(1, samples + 1)) / self.rate
        self._taken += samples
        last = self._sample_now(stage)
        # a step's sensors describe the state before it, so sample k is what step k * per_sample saw
        return Samples.concatenate([self._samples(recorded[:, self.per_sample :: self.per_sample], times[:-1]), last])

    def _sample_now(self, stage: mujoco.mjtStage = mujoco.mjtStage.mjSTAGE_ACC) -> Samples:
        self._run(lambda: self._batch.forward(stage=int(stage)))
        bad = ~np.isfinite(self._batch.bind("qpos")).all(axis=1)
        self.diverged |= bad | (self._warnings() > self._warned)
        return self._samples(self._sensordata[:, None, :], np.array([self.time]))

    def _warnings(self) -> np.ndarray:
        """(B,) how often MuJoCo warned of each simulation."""
        return self._batch.warning.reshape(self.count, -1).sum(axis=1)

    def _samples(self, data: np.ndarray, times: np.ndarray) -> Samples:
        return self._signals.samples(data, times, self.fields.compliance, self._power.back_emf)

    def _remember(self, new: Samples) -> None:
        joined = new if self._raw is None else Samples.concatenate([self._raw, new])
        keep = max(round(MEMORY_S * self.rate), len(new.time))
        recent = joined.map(lambda values: values[:, -keep:])
        self._raw = dataclasses.replace(recent, time=joined.time[-keep:])

    def _readings(self, raw: Samples, times: np.ndarray | None = None) -> Samples:
        if times is None:
            history = self._raw
            self._remember(raw)
        else:
            history = None
        sensing = self.fields.sensing
        if not sensing.latency.any():
            return sense(raw, sensing)
        source = self._raw if history is None else Samples.concatenate([history, raw])
        assert source is not None
        late = delay(source, sensing.latency, raw.time)
        return sense(dataclasses.replace(late, position=raw.position), sensing)  # the tracker is none of the robot's

    def _state(self) -> State:
        return State(
            self.time,
            self._batch.bind("qpos")[:, self._qpos],
            self._batch.bind("qvel")[:, self._dofs],
            self._actuator_force[:, self._actuators],
        )
