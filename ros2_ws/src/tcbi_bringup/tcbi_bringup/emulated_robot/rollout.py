"""Rollouts without the wire: the same robot and sensors, faster than real time.

    robot = EmulatedRobot(seed=7, hidden="coulomb_friction")
    recording = robot.rollout(Scene(), 8.0, Script(time, target))          # open loop
    recording = robot.rollout(Scene(slope_pitch=0.2), 8.0, controller)     # closed loop at 5 Hz

A script's or controller's command acts from its time on. The same robot, trial and request give the same bits.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.mechanics import Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen
from tcbi_contract.names import CONTROL_PERIOD_S, JOINT_LIMIT, JOINTS, SENSOR_RATE_HZ

RAMP_S = 0.2
TRACKER_NOISE = 0.001  # m


@dataclass(frozen=True)
class Script:
    """Commands on the rollout's clock: time (K,) s, strictly increasing; target (K, 18) rad; ramp in s."""

    time: np.ndarray
    target: np.ndarray
    ramp: float = RAMP_S


class Controller(Protocol):
    """A policy in the loop, one robot at a time (the leading dimension is 1)."""

    def reset(self, count: int, rng: np.random.Generator) -> None:
        """Start a rollout."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """(1, 21) joint angles, roll, pitch and yaw since the start (rad) -> (1, 18) targets (rad)."""


@dataclass(frozen=True)
class Recording:
    """One rollout as measured: T samples at 50 Hz, K commands; units and frames as in `physics.Sample`."""

    time: np.ndarray  # (T,) s, 0 at the start
    joint_position: np.ndarray  # (T, 18)
    attitude: np.ndarray  # (T, 4) w x y z
    angular_velocity: np.ndarray  # (T, 3)
    linear_acceleration: np.ndarray  # (T, 3)
    contact: np.ndarray  # (T, 6) bool
    position: np.ndarray  # (T, 3) m, a tracker's, in the world
    command_time: np.ndarray  # (K,) s
    command_target: np.ndarray  # (K, 18) rad
    ramp: float  # s

    @property
    def distance(self) -> float:
        """m that the base went along the world's x axis."""
        return float(self.position[-1, 0] - self.position[0, 0])


class EmulatedRobot:
    """A specimen that rollouts are asked of; see `Specimen.of` for the arguments."""

    def __init__(self, seed: int, hidden: str | None = None, strength: str | None = None):
        self.specimen = Specimen.of(seed, hidden, strength)

    def rollout(
        self,
        scene: Scene,
        duration: float,
        commands: Script | Controller,
        *,
        initial: np.ndarray | None = None,
        settle: float = 1.0,
        trial: int = 0,
    ) -> Recording:
        """Put the robot down, let it stand for `settle` seconds, then run and record.

        Args:
          scene: ground and heading.
          duration: s.
          commands: a script (open loop) or a controller (closed loop, 5 Hz).
          initial: (18,) rad, posture before time 0; None for the neutral stance.
          settle: s.
          trial: repeats differ in sensor noise and bus jitter alone.

        Raises:
          EmulatedRobotError: commands of the wrong shape.
        """
        posture = np.zeros(len(JOINTS)) if initial is None else np.asarray(initial, float)
        physics = Physics(self.specimen, trial)
        physics.place(scene, posture)
        physics.advance_to(settle)
        feed = _ScriptFeed(commands) if isinstance(commands, Script) else _ControllerFeed(commands, self._rng(6, trial))
        return _record(physics, feed, settle, duration, self._rng(5, trial))

    def _rng(self, stream: int, trial: int) -> np.random.Generator:
        """One of this robot's streams in a trial; those up to 4 make the robot and its sensors."""
        return np.random.default_rng([self.specimen.seed, stream, trial])


class _ScriptFeed:
    def __init__(self, script: Script):
        if script.target.shape != (len(script.time), len(JOINTS)) or np.any(np.diff(script.time) <= 0):
            raise EmulatedRobotError(
                f"a script needs K strictly increasing times and (K, {len(JOINTS)}) targets, "
                f"got {np.shape(script.time)} and {np.shape(script.target)}"
            )
        self._script, self.ramp, self._next = script, script.ramp, 0

    def next_time(self) -> float:
        times = self._script.time
        return float(times[self._next]) if self._next < len(times) else np.inf

    def act(self, physics: Physics) -> np.ndarray:
        self._next += 1
        return self._script.target[self._next - 1]


class _ControllerFeed:
    def __init__(self, controller: Controller, rng: np.random.Generator):
        controller.reset(1, rng)
        self._controller, self.ramp, self._tick = controller, RAMP_S, 0
        self._yaw0: float | None = None

    def next_time(self) -> float:
        return self._tick * CONTROL_PERIOD_S

    def act(self, physics: Physics) -> np.ndarray:
        sample = physics.read()
        roll, pitch, yaw = roll_pitch_yaw(sample.attitude)
        self._yaw0 = yaw if self._yaw0 is None else self._yaw0
        turned = (yaw - self._yaw0 + np.pi) % (2 * np.pi) - np.pi
        observation = np.concatenate([sample.joint_position, [roll, pitch, turned]])
        target = self._controller.act(self.next_time(), observation[None])[0]
        self._tick += 1
        return np.asarray(target, float)


def _record(
    physics: Physics, feed: _ScriptFeed | _ControllerFeed, start: float, duration: float, rng: np.random.Generator
) -> Recording:
    count = round(duration * SENSOR_RATE_HZ) + 1
    samples, positions = [], []
    given: list[tuple[float, np.ndarray]] = []
    for k in range(count):
        now = k / SENSOR_RATE_HZ
        while feed.next_time() <= now + 1e-9 and (k < count - 1 or not given):
            at = feed.next_time()
            physics.advance_to(start + at)
            target = np.clip(feed.act(physics), -JOINT_LIMIT, JOINT_LIMIT)
            physics.send(target, feed.ramp)
            given.append((at, target))
        physics.advance_to(start + now)
        samples.append(physics.read())
        positions.append(physics.true_position() + rng.normal(0.0, TRACKER_NOISE, 3))
    return Recording(
        time=np.arange(count) / SENSOR_RATE_HZ,
        joint_position=np.stack([s.joint_position for s in samples]),
        attitude=np.stack([s.attitude for s in samples]),
        angular_velocity=np.stack([s.angular_velocity for s in samples]),
        linear_acceleration=np.stack([s.linear_acceleration for s in samples]),
        contact=np.stack([s.contact for s in samples]),
        position=np.stack(positions),
        command_time=np.array([at for at, _ in given]),
        command_target=np.array([target for _, target in given]).reshape(-1, len(JOINTS)),
        ramp=feed.ramp,
    )


def roll_pitch_yaw(attitude: np.ndarray) -> tuple[float, float, float]:
    """(4,) w x y z -> rad, of Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = (float(v) for v in attitude)
    return (
        float(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        float(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))),
        float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
    )
