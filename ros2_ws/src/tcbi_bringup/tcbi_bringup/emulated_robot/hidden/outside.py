"""What no library of effects has: a diagnosis must say that something else is missing."""

import math

import mujoco
import numpy as np

from tcbi_bringup.emulated_robot.character import JOINT_COUNT
from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden.friction import Bristles
from tcbi_bringup.emulated_robot.hidden.power import MotorEffect
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.mechanics import Build
from tcbi_bringup.emulated_robot.servos import LOOP_PERIOD_S
from tcbi_contract.names import LEGS


class BentLeg(HiddenEffect):
    """One shin bent sideways at the knee: its foot stands beside where it should."""

    strong, weak = 0.30, 0.12  # rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self._leg = str(rng.choice(LEGS))
        self._angle = self.size * float(rng.choice([-1.0, 1.0]))
        self.truth = {"leg": self._leg, "bend_rad": self._angle}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.shin_bend[self._leg] = self._angle


class UnequalLegs(HiddenEffect):
    """Shins of different lengths, as somebody cut them by eye."""

    strong, weak = 0.08, 0.03  # standard deviation over length

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        length = rng.permutation(np.linspace(-1.4, 1.4, len(LEGS)))
        self._factor = {leg: 1.0 + self.size * float(v) for leg, v in zip(LEGS, length, strict=True)}
        self.truth = {f"{leg}_length_factor": factor for leg, factor in self._factor.items()}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.shin_length.update(self._factor)


class StickyFeet(HiddenEffect):
    """Feet with soft pads that stick where they stood and have to be peeled off."""

    strong, weak = 0.8, 0.3  # N, that each foot holds on with

    PEELED = 0.002  # m above where the foot stood, at which the pad lets go
    TOUCHING = 0.05  # N

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"adhesion_n": self.size}
        self._stuck, self._stood = np.zeros(len(LEGS), bool), np.zeros(len(LEGS))

    def bind(self, model: mujoco.MjModel) -> None:
        self._feet = [model.geom(f"{leg}_foot").id for leg in LEGS]
        self._shins = [model.body(f"{leg}_tibia").id for leg in LEGS]
        self._stuck[:] = False

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        foot, touching = data.geom_xpos[self._feet], data.sensordata[6:] > self.TOUCHING
        self._stood = np.where(touching, foot[:, 2], self._stood)
        self._stuck = touching | (self._stuck & (foot[:, 2] < self._stood + self.PEELED))
        lever, pull = foot - data.xipos[self._shins], np.where(self._stuck, self.size, 0.0)
        force = np.stack([np.zeros_like(pull), np.zeros_like(pull), -pull], axis=-1)
        data.xfrc_applied[self._shins, :3] += force
        data.xfrc_applied[self._shins, 3:] += np.cross(lever, force)


class IntegratingServo(MotorEffect):
    """Servos with an integral term in their position loop, limited as firmware limits it: sag goes, overshoot comes."""

    strong, weak = 2.5, 0.8  # 1/s, the integral's gain over the proportional one

    LIMIT = 0.25  # of full torque, that the integral may add

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"integral_rate_per_s": self.size}
        self._sum = np.zeros(JOINT_COUNT)

    def reset(self, position: np.ndarray) -> None:
        self._sum[:] = 0.0

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        most = self.LIMIT * self.stall
        self._sum = np.clip(self._sum + self.size * LOOP_PERIOD_S * torque, -most, most)
        np.clip(torque + self._sum, -self.stall, self.stall, out=torque)
        return torque


class OneWayFriction(HiddenEffect):
    """Worm-like gears that rub in one sense of turning only, whatever the load."""

    strong, weak = 0.09, 0.035  # N m, against turning towards positive angles

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"one_way_torque_n_m": self.size}
        self._bristles = Bristles()

    def reset(self, position: np.ndarray) -> None:
        self._bristles.reset()

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        return self._bristles.torque(velocity, np.where(velocity > 0, self.size, self.size / 20), dt)


class Cogging(HiddenEffect):
    """Magnets that snap to the motor's poles: a torque that comes and goes with the angle of the joint."""

    strong, weak = 0.08, 0.03  # N m, amplitude

    PERIOD = 2 * math.pi / 60  # rad of the joint

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"torque_n_m": self.size, "period_rad": self.PERIOD}
        self._phase = rng.uniform(-math.pi, math.pi, JOINT_COUNT)

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.qfrc_applied[6:] += self.size * np.sin(data.qpos[7:] * (2 * math.pi / self.PERIOD) + self._phase)


class LooseImu(HiddenEffect):
    """An IMU on a foam pad: it swings about two axes on a spring, pushed by the trunk's accelerations and rates."""

    strong, weak = 4.0, 8.0  # Hz, of the swinging

    DAMPING = 0.12  # of critical
    LEVER = 0.004  # m of the board's middle above the pad
    GYRATION = 0.012  # m, radius of the board's inertia

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"swing_hz": self.size, "damping_ratio": self.DAMPING}
        self._angle, self._rate, self._trunk = np.zeros(2), np.zeros(2), np.zeros(2)

    def reset(self, position: np.ndarray) -> None:
        self._angle, self._rate, self._trunk = np.zeros(2), np.zeros(2), np.zeros(2)

    def mount(self, motion: np.ndarray, dt: float) -> np.ndarray:
        """Roll and pitch of the board against the trunk: it lags the trunk's turns and tips under its accelerations."""
        speed = 2 * math.pi * self.size
        tipping = self.LEVER / self.GYRATION**2 * np.array([motion[4], -motion[3]])
        push = tipping - speed**2 * self._angle - 2 * self.DAMPING * speed * self._rate
        self._rate = self._rate + dt * push - (motion[:2] - self._trunk)
        self._trunk = motion[:2].copy()
        self._angle = self._angle + dt * self._rate
        roll, pitch = self._angle
        x, y, z = motion[3:]
        turning = (motion[0] + self._rate[0], motion[1] + self._rate[1], motion[2])
        return np.array([*turning, x - pitch * z, y + roll * z, z + pitch * x - roll * y])


class SwappedPackets(HiddenEffect):
    """A relay that now and then lets a packet wait until the next one has passed: the old goals come last and win."""

    strong, weak = 0.25, 0.10  # of the packets

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"swapped_share": self.size}
        self._late: dict[int, float] = {}  # goals of a packet that waits
        self._winning: dict[int, float] = {}  # goals that come right after the present packet
        self._waits = False

    def reset(self, position: np.ndarray) -> None:
        self._late, self._winning, self._waits = {}, {}, False

    def hear(self, goals: list[tuple[int, float]], fresh: bool, rng: np.random.Generator) -> list[tuple[int, float]]:
        if fresh:
            self._winning, self._late = self._late, {}
            self._waits = not self._winning and rng.random() < self.size
        if self._waits:
            self._late.update(goals)
            return []
        return [(i, self._winning.get(i, goal)) for i, goal in goals]
