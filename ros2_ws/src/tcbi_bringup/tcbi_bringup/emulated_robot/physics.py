"""One emulated robot on its ground: half-millisecond mechanics under 1 kHz servos, a hidden effect, real sensors.

The motion is decided by the robot's seed, its hidden effect and the commands; the trial number draws what differs
between two repeats of the same run: how the robot was put down, the noise of the sensors, the waits on a jittery bus.

    physics = Physics(Specimen.of(seed=7, hidden="backlash"), trial=0)
    physics.place(Scene(slope_roll=0.2), np.zeros(18))
    physics.send(np.full(18, 0.1), duration=0.2)
    physics.advance_to(physics.time + 0.5)
    sample = physics.read()
"""

import dataclasses
import math
from collections import deque
from dataclasses import dataclass, field

import mujoco
import numpy as np

from tcbi_bringup.emulated_robot import character as characters
from tcbi_bringup.emulated_robot import drawing as drawings
from tcbi_bringup.emulated_robot import hidden_effects, mechanics
from tcbi_bringup.emulated_robot.character import Character
from tcbi_bringup.emulated_robot.circumstances import Circumstances
from tcbi_bringup.emulated_robot.gear import GearGap
from tcbi_bringup.emulated_robot.mechanics import GRAVITY, Build, Scene
from tcbi_bringup.emulated_robot.sensors import POLL_TICKS, Encoders, FootSwitches, Imu
from tcbi_bringup.emulated_robot.servos import LOOP_PERIOD_S, STEP, Move, Servos

SUBSTEPS = round(LOOP_PERIOD_S / mechanics.STEP_S)
PACKET_S = 0.003  # goals sent within this time travel in one packet
DROP_HEIGHT = 0.001  # m between the lowest foot and the ground when the robot is let go
REST_TICKS, REST = 500, 1e-3  # a limp robot that moved and bent by less (m, rad) in so many ticks lies still


@dataclass(frozen=True)
class Specimen:
    """Which robot this is: its plain parameters and what is hidden in it."""

    seed: int
    hidden: str
    strength: str
    character: Character

    @staticmethod
    def of(seed: int, hidden: str | None = None, strength: str | None = None) -> "Specimen":
        """Robot number `seed`; its hidden effect is drawn from the seed unless it is named.

        Raises:
          EmulatedRobotError: an unknown effect or strength, or a negative seed.
        """
        character = characters.draw(seed)
        name, strength, _ = hidden_effects.choose(hidden, strength, seed)
        return Specimen(seed, name, strength, character)

    def truth(self) -> dict[str, object]:
        """What nobody but the judge should see: parameters, the hidden effect and its size."""
        effect = hidden_effects.choose(self.hidden, self.strength, self.seed)[2]
        c = self.character
        values = {"friction": c.friction, "mass": c.mass, "gain": c.gain}
        return {"seed": self.seed, "hidden": self.hidden, "strength": self.strength, **values, "effect": effect.truth}


@dataclass(frozen=True)
class Sample:
    """What the sensors say at one instant.

    Attributes:
      time: s on the robot's clock.
      joint_position: (18,) rad.
      attitude: (4,) base in world, w x y z.
      angular_velocity: (3,) rad/s in `imu_link`.
      linear_acceleration: (3,) m/s^2 with gravity in `imu_link`.
      contact: (6,) bool.
      load: (18,) share of the servos' full torque.
    """

    time: float
    joint_position: np.ndarray
    attitude: np.ndarray
    angular_velocity: np.ndarray
    linear_acceleration: np.ndarray
    contact: np.ndarray
    load: np.ndarray


@dataclass(frozen=True)
class Rest:
    """Whether a robot lies still.

    Attributes:
      posture: (nq,) at the last look; None before the first.
      still: whether its mechanics stand.
      motion: (6,) what the IMU undergoes then, without the mount: rad/s, then m/s^2 with gravity.
    """

    posture: np.ndarray | None = None
    still: bool = False
    motion: np.ndarray = field(default_factory=lambda: np.zeros(6))


class Physics:
    """A specimen in motion.

    Args:
      specimen: which robot.
      trial: 0 or more; repeats with other numbers differ in circumstances, noise and jitter alone.
    """

    def __init__(self, specimen: Specimen, trial: int = 0):
        self.specimen = specimen
        self._drawing = drawings.load()
        character, drawing = specimen.character, self._drawing
        self._effect = hidden_effects.choose(specimen.hidden, specimen.strength, specimen.seed)[2]
        self._build = Build(drawing.damping, drawing.armature, [])
        self._effect.attach(self._build, drawing)
        self._gear = GearGap.of(self._build, characters.JOINT_COUNT)
        hooks = ("drive", "resist", "act", "mount")
        self._drives, self._resists, self._acts, self._mounts = (self._effect.uses(hook) for hook in hooks)
        limit = np.full(characters.JOINT_COUNT, drawing.torque_limit)
        self._gain = character.gain * character.gain_factor
        for servo, factor in self._build.gain_factor.items():
            self._gain[servo] *= factor
        self.servos = Servos(self._gain.copy(), limit, drawing.speed_limit)
        streams = [np.random.default_rng([specimen.seed, 3, trial, part]) for part in range(5)]
        self._bus, imu, encoders, switches, self._hands = streams
        self._encoders = Encoders(encoders)
        self._imu = Imu(np.random.default_rng([specimen.seed, 4]), imu, LOOP_PERIOD_S)
        self._switches = FootSwitches(drawing.foot_threshold * character.switch_factor, switches, LOOP_PERIOD_S)
        self._packet = (-1.0, 0.0)  # s, when the latest packet was sent and when it comes in, if ever
        behind = self._effect.polls_behind
        self._polled: deque[Sample] = deque(maxlen=behind + 1 if behind else 0)
        self._clock = 0  # ticks since the robot was switched on
        self._rest = Rest()
        self._torque = np.zeros(characters.JOINT_COUNT)
        self._encoder = np.zeros(characters.JOINT_COUNT)
        self.place(Scene(), np.zeros(characters.JOINT_COUNT))

    @property
    def time(self) -> float:
        """s on the robot's clock."""
        return self._clock * LOOP_PERIOD_S

    @property
    def shaft(self) -> np.ndarray:
        """(18,) rad, where the encoders' magnets truly stand."""
        return self._angles if self._gear is None else self._gear.position

    def place(self, scene: Scene, joint_position: np.ndarray | None = None) -> None:
        """Set up the ground and put the robot down on it at rest, with its middle over the origin, as well as one can.

        Args:
          scene: ground and heading.
          joint_position: (18,) rad that the servos then hold; None leaves the servos as they are. While the robot is in
            the hands its legs hang free: servos under torque bring their joints to where they were told, and limp ones
            are laid into the neutral stance.
        """
        if joint_position is None:
            angles = shaft = np.where(self.servos.on > 0, self.servos.goal, 0.0)
        else:
            angles = shaft = np.array(joint_position, float)
        self._rest = Rest()
        self._build_on(scene, Circumstances.draw(self._hands))
        self._angles[:] = angles
        self._stand_on_the_ground(self.scene.yaw)
        self._effect.reset(angles)
        if self._gear is not None:
            self._gear.reset(shaft)
        if joint_position is not None:
            self.servos.reset(joint_position)
        self._encoder = np.rint(self.shaft / STEP) * STEP
        chip = self._chip()
        self._imu.reset(chip, weight_seen_by(chip))  # at rest; the robot has yet to fall the last hair
        self._switches.reset()
        self._polled.clear()

    def send(self, goals: np.ndarray, duration: float, speed: float = 0.0) -> None:
        """Send goals (18,) rad to all servos in one packet; each ramps to its own within `duration` (s)."""
        self.send_each([(i, float(goal)) for i, goal in enumerate(goals)], duration, speed)

    def send_each(self, goals: list[tuple[int, float]], duration: float, speed: float = 0.0) -> None:
        """Send goals (servo, rad) in one packet."""
        fresh = self.time - self._packet[0] > PACKET_S
        if fresh:
            self._packet = (self.time, self.time + self._effect.bus_delay(self._bus))
        if math.isinf(self._packet[1]):
            return
        for index, goal in self._effect.hear(goals, fresh, self._bus):
            self.servos.send(Move(self._packet[1], index, goal, duration, speed))

    def switch(self, index: int, on: bool) -> None:
        """Torque of one servo on or off."""
        if on != self.servos.on[index]:
            self._rest = Rest()  # on, it stands up; off, it falls
        self.servos.switch(index, on, float(self.shaft[index]))

    def advance_to(self, time: float) -> None:
        """Move on to `time` (s), in whole turns of the servos' loops."""
        target = round(time / LOOP_PERIOD_S)
        while self._clock < target:
            self._tick()

    def read(self) -> Sample:
        """The sensors, now; what an old reading says is stamped now all the same."""
        return dataclasses.replace(self._polled[0], time=self.time) if self._polled else self._sample()

    def supply(self) -> float:
        """Volts at the servos over those of a battery without load, as far as the hidden effect changes them."""
        return self._effect.supply()

    def warmth(self) -> np.ndarray | float:
        """(18,) K by which the servos are warmer than their load explains."""
        return self._effect.warmth()

    def _sample(self) -> Sample:
        attitude, gyro, acceleration = self._imu.read()
        return Sample(
            time=self.time,
            joint_position=self._encoders.read(self.shaft),
            attitude=attitude,
            angular_velocity=self._effect.gyro(gyro, self.time),
            linear_acceleration=acceleration,
            contact=self._switches.read(self.time),
            load=np.clip(self._torque / self.servos.torque_limit, -1.0, 1.0),
        )

    def true_position(self) -> np.ndarray:
        """(3,) m, the origin of `base_link` in the world."""
        position = np.zeros(3)
        mujoco.mju_rotVecQuat(position, self.data.qpos[:3], ground_attitude(self.scene))
        return position

    def true_attitude(self) -> np.ndarray:
        """(4,) w x y z, `base_link` in the world."""
        attitude = np.zeros(4)
        mujoco.mju_mulQuat(attitude, ground_attitude(self.scene), self.data.qpos[3:7])
        return attitude

    def _build_on(self, scene: Scene, now: Circumstances) -> None:
        """Compile robot and ground, and take views of the state that the loop works on."""
        roll, pitch = self._build.slope
        self.scene = dataclasses.replace(
            scene,
            slope_roll=scene.slope_roll + now.slope_roll + roll,
            slope_pitch=scene.slope_pitch + now.slope_pitch + pitch,
            yaw=scene.yaw + now.yaw,
        )
        character = self.specimen.character
        character = dataclasses.replace(character, friction=character.friction * now.friction_factor)
        self.servos.gain[:] = self._gain * now.supply_factor
        self.model = mechanics.compile_model(self._drawing, character, self._build, self.scene)
        self.data = mujoco.MjData(self.model)
        self._angles, self._speeds = self.data.qpos[7:], self.data.qvel[6:]
        self._force = self.data.qfrc_applied[6:]
        self._motion, self._feet = self.data.sensordata[:6], self.data.sensordata[6:]
        self._effect.bind(self.model)

    def _tick(self) -> None:
        effect = self._effect
        if self._rest.still:
            motion = self._rest.motion
            if self._drives:  # what has grown hot cools
                effect.drive(np.zeros(characters.JOINT_COUNT), np.zeros(characters.JOINT_COUNT))
        else:
            self._move()
            motion = self._motion
            if self._clock % REST_TICKS == 0:
                self._look_whether_it_lies_still()
        self._clock += 1
        self._imu.tick(effect.mount(motion, LOOP_PERIOD_S) if self._mounts else motion)
        self._switches.tick(self._feet, self.time)
        if self._polled.maxlen and self._clock % POLL_TICKS == 0:
            self._polled.append(self._sample())

    def _move(self) -> None:
        """Mechanics and servos, a turn of the servos' loops."""
        encoder, effect, gear = self._encoder, self._effect, self._gear
        np.divide(self.shaft, STEP, out=encoder)
        np.rint(encoder, out=encoder)
        np.multiply(encoder, STEP, out=encoder)
        torque = self.servos.torque(self.time + LOOP_PERIOD_S / 2, encoder)
        speeds = self._speeds if gear is None else gear.velocity
        if self._drives:
            torque = effect.drive(torque, speeds) * self.servos.on
        self._torque = torque
        if self._resists:
            torque = torque + effect.resist(speeds, LOOP_PERIOD_S)
        if gear is not None:
            torque = gear.push(torque, self._angles, self._speeds, LOOP_PERIOD_S)
        self._force[:] = torque
        if self._acts:
            self.data.xfrc_applied[:] = 0.0
            effect.act(self.model, self.data)
        mujoco.mj_step(self.model, self.data, SUBSTEPS)

    def _look_whether_it_lies_still(self) -> None:
        """A limp robot that does not move any more is left alone until a servo is switched on or hands come."""
        posture = self.data.qpos.copy()
        before, self._rest = self._rest.posture, Rest(posture)
        if before is None or self.servos.on.any() or np.abs(posture - before).max() > REST:
            return
        self.data.qvel[:] = 0.0
        self._rest = Rest(posture, still=True, motion=np.concatenate([np.zeros(3), weight_seen_by(self._chip())]))

    def _chip(self) -> np.ndarray:
        """(4,) w x y z, the IMU in the world."""
        chip = np.zeros(4)
        mujoco.mju_mulQuat(chip, self.true_attitude(), np.array(mechanics.tilted(*self._build.imu_tilt)))
        return chip

    def _stand_on_the_ground(self, yaw: float) -> None:
        """Lift the robot until nothing touches, then lower it until its lowest part is a hair above what lies below."""
        data, model = self.data, self.model
        data.qpos[3:7] = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        low, high = 0.0, 1.0
        while high - low > DROP_HEIGHT / 4:
            data.qpos[2] = (low + high) / 2
            mujoco.mj_forward(model, data)
            if any(1 in (model.geom_contype[c.geom[0]], model.geom_contype[c.geom[1]]) for c in data.contact):
                low = data.qpos[2]
            else:
                high = data.qpos[2]
        data.qpos[2] = high + DROP_HEIGHT
        mujoco.mj_forward(model, data)


def weight_seen_by(chip: np.ndarray) -> np.ndarray:
    """(3,) m/s^2 that an accelerometer at rest measures whose attitude in the world is (4,) w x y z."""
    back, seen = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, chip)
    mujoco.mju_rotVecQuat(seen, np.array([0.0, 0.0, GRAVITY]), back)
    return seen


def ground_attitude(scene: Scene) -> np.ndarray:
    """(4,) w x y z of Ry(pitch) Rx(roll), the ground in the world."""
    return np.array(mechanics.tilted(scene.slope_roll, scene.slope_pitch))
