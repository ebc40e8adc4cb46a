"""One simulated robot that obeys commands as the real one does: limits, silence, emergency stop, sensor noise.

    live = LiveSimulation(model, scenario, seed=3)
    first = live.reset(scenario)
    live.command(target, duration_s=0.2)              # refused as the robot would refuse it
    for reading in live.advance(10): ...              # the next ten samples

Time is the simulation's own, in seconds since the last reset. Everything random comes from the seed of that reset, so
that the same scenario and commands give the same bits, whatever went before.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcbi_contract.safety import CommandRefused, Limits, Mode, Move, Safety
from tcbi_sim.engine import Simulator
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import Samples, add_noise, tilted

NOISE_STREAM, DRAW_STREAM = 104_729, 1_299_709  # children of a seed, apart from those of scenario and engine
POSTURE_RAMP_S = 0.2


@dataclass(frozen=True)
class Reading:
    """What the robot's sensors say at one instant.

    Attributes:
      joint_position: (J,) rad.
      orientation: (4,) base in world, x y z w, as the IMU tells it.
      angular_velocity: (3,) rad/s in `imu_link`.
      linear_acceleration: (3,) m/s^2 with gravity in `imu_link`.
      contact: (F,) bool.
      position, facing: (3,) m and (4,) x y z w, base in world, as a tracker beside the robot sees it.
    """

    joint_position: np.ndarray
    orientation: np.ndarray
    angular_velocity: np.ndarray
    linear_acceleration: np.ndarray
    contact: np.ndarray
    position: np.ndarray
    facing: np.ndarray


class LiveSimulation:
    """A robot in simulation, with the electronics' manners.

    Attributes:
      model: in use.
      scenario: of the last reset.
      safety: what the robot may do now.
      refused: commands refused since the last reset, as told to `refuse`.
      reason: why the last one was.
    """

    def __init__(
        self,
        model: Model,
        scenario: Scenario,
        *,
        timestep: float = 0.002,
        noise: bool = True,
        draw: bool = False,
        limits: Limits | None = None,
    ):
        """Stand the robot at the scenario's start, limp.

        Args:
          model: whose rig must have joints, IMU and feet as the contract says.
          scenario: of the first episode.
          timestep: s, of the physics.
          noise: whether the sensors have the rig's noise and encoder steps.
          draw: take the physical parameters from the model's distribution by each scenario's seed; else its mean.
          limits: of the commands; the robot's own by default.
        """
        self.limits = limits or Limits()
        self.safety = Safety(self.limits)
        self.refused, self.reason = 0, ""
        self._timestep, self._noise, self._draw = timestep, noise, draw
        self._load(model, scenario)

    @property
    def period(self) -> float:
        """Seconds between samples."""
        return 1 / self._simulator.rate

    @property
    def diverged(self) -> bool:
        """Whether the physics broke down; only a reset mends it."""
        return bool(self._simulator.diverged[0])

    @property
    def simulator(self) -> Simulator:
        """The engine behind it."""
        return self._simulator

    def reset(self, scenario: Scenario, model: Model | None = None) -> Reading:
        """Put the robot at the start of an episode, holding its initial posture.

        Raises:
          CommandRefused: the emergency stop stands.
          SimError: the model cannot be simulated; the one before stays in use.
        """
        if self.safety.mode is Mode.STOPPED:
            raise CommandRefused("reset: the emergency stop stands; call emergency_stop/release first")
        self._load(model or self.model, scenario)
        self.refused, self.reason = 0, ""
        (first,) = self._readings(self._simulator.observe())
        self._hold(scenario)
        return first

    def command(self, target: Sequence[float], duration_s: float, later_s: float = 0.0) -> Move:
        """Move all joints linearly from the last commanded position.

        Args:
          target: (J,) rad.
          duration_s: of the move.
          later_s: when it begins, after the present time and before the next sample.

        Raises:
          CommandRefused: the robot would refuse it.
        """
        move = self.safety.command(self._now + later_s, target, duration_s)
        self._begin(move, later_s)
        return move

    def refuse(self, reason: str) -> None:
        """Count a command that did not get through."""
        self.refused, self.reason = self.refused + 1, reason

    def stop(self) -> None:
        """Emergency stop: torque off until released, and until the next reset."""
        self.safety.stop()
        self._simulator.set_torque(False)

    def release(self) -> bool:
        """End the emergency stop; the robot stays limp. False if none stood."""
        return self.safety.release()

    def advance(self, count: int) -> list[Reading]:
        """Simulate and read the next `count` samples; empty once the physics has broken down."""
        readings: list[Reading] = []
        while count > 0 and not self.diverged:
            step = count if self._quiet(count) else 1
            readings += self._readings(self._simulator.advance(step * self.period))
            if self.safety.tick(self._now):
                self._simulator.set_torque(False)
            count -= step
        return [] if self.diverged else readings

    # -- inside ---------------------------------------------------------------------------------------------------

    @property
    def _now(self) -> float:
        return self._simulator.time

    def _load(self, model: Model, scenario: Scenario) -> None:
        rig = load_rig(model.rig)
        if not (rig.floating and rig.has_imu and rig.foot_names):
            raise SimError(
                f"model {model.version!r} is of the rig {rig.name!r}, which is no walking robot; use a hexapod model"
            )
        simulator = Simulator(model, self._parameters(model, scenario), [scenario], self._timestep, threads=1)
        simulator.set_torque(self.safety.mode is Mode.ACTIVE)
        # only now: a model that fails leaves the one before in use
        self.model, self.scenario, self._rig, self._simulator = model, scenario, rig, simulator
        self._rng = np.random.default_rng([scenario.seed, NOISE_STREAM])

    def _parameters(self, model: Model, scenario: Scenario) -> np.ndarray:
        if not self._draw:
            return model.mean()[None]
        return model.sample(np.random.default_rng([scenario.seed, DRAW_STREAM]), 1)

    def _hold(self, scenario: Scenario) -> None:
        """Arm the robot in its initial posture, as the driver does at the end of its slow move there."""
        posture = scenario.initial_joint_position or (0.0,) * len(self._rig.joint_names)
        self.safety.go_limp("reset")
        self.safety.measured(self._now, posture)
        self.safety.begin_reset(self._now)
        self.safety.command(self._now, posture, POSTURE_RAMP_S, from_reset=True)
        self.safety.hold(self._now)
        self._simulator.set_torque(True)

    def _begin(self, move: Move, later_s: float) -> None:
        path = self._simulator.path
        if move.arm:  # a servo that wakes up must not go on to an old goal
            path.hold(np.array([0]), np.array([move.start]), self._rng.spawn(1))
            self._simulator.set_torque(True)
        path.give(self._simulator.time + later_s, np.array([move.target]), move.duration_s)

    def _quiet(self, count: int) -> bool:
        """Whether nothing can go limp within `count` samples, so that they may be simulated in one go."""
        return self.safety.patience(self._now) > (count + 1) * self.period

    def _readings(self, samples: Samples) -> list[Reading]:
        facing = self._simulator.unsensed(len(samples.time)).attitude
        assert facing is not None
        if self._noise:
            samples = add_noise(samples, self._rig.noise, self._rng)
            facing = tilted(facing, self._rig.noise.attitude, self._rng)
        assert samples.attitude is not None and samples.angular_velocity is not None
        assert samples.linear_acceleration is not None and samples.contact is not None and samples.position is not None
        orientation, facing = np.roll(samples.attitude, -1, axis=-1), np.roll(facing, -1, axis=-1)
        self.safety.measured(float(samples.time[-1]), samples.joint_position[0, -1].tolist())
        return [
            Reading(
                samples.joint_position[0, k],
                orientation[0, k],
                samples.angular_velocity[0, k],
                samples.linear_acceleration[0, k],
                samples.contact[0, k],
                samples.position[0, k],
                facing[0, k],
            )
            for k in range(len(samples.time))
        ]
