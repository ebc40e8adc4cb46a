"""What the robot carries, stands on and is held by: a box, foam, an oily half of the floor, a wrong slope, a cable."""

import math

import mujoco
import numpy as np

from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.mechanics import Build, Load
from tcbi_contract.names import LEGS


class Backpack(HiddenEffect):
    """A box screwed to the trunk's top, off its middle."""

    strong, weak = 0.20, 0.08  # kg

    SIZE = (0.050, 0.040, 0.030)  # m

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        corner = rng.choice([-1.0, 1.0], 2) * rng.uniform((0.035, 0.015), (0.065, 0.035))
        self._xy = (float(corner[0]), float(corner[1]))
        self.truth = {"mass_kg": self.size, "x_m": self._xy[0], "y_m": self._xy[1]}
        self.truth |= {f"moment_{axis}_kg_m": self.size * r for axis, r in zip("xy", self._xy, strict=True)}

    def attach(self, build: Build, drawing: Drawing) -> None:
        height = (drawing.trunk_size[2] + self.SIZE[2]) / 2
        build.loads.append(Load(self.size, (*self._xy, height), self.SIZE))


class Foam(HiddenEffect):
    """Ground that gives way like foam: springs and dampers under the feet, stiffer the deeper these sink."""

    strong, weak = 0.035, 0.012  # s, in which a foot springs back, beyond firm ground's

    FIRM_S = 0.008
    DAMPING = 0.8  # of critical
    DEPTH = 0.004  # m, over which the foam stiffens

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"time_constant_s": self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        time = self.FIRM_S + self.size
        build.contact = {
            "solref": f"{-1.0 / time**2!r} {-2.0 * self.DAMPING / time!r}",
            "solimp": f"0.9 0.97 {self.DEPTH!r} 0.5 2",
        }


class OilyFloor(HiddenEffect):
    """Oil on one side of a line through the start: each foot's grip falls over a finger's breadth beyond it."""

    strong, weak = 0.50, 0.80  # of the friction elsewhere

    EDGE = 0.02  # m, over which the grip falls

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        heading, begin = rng.uniform(-math.pi, math.pi), rng.uniform(-0.03, 0.03)
        self._direction, self._begin = np.array([math.cos(heading), math.sin(heading)]), begin
        self.truth = {"grip": self.size, "begin_m": begin, "heading_rad": heading}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.feet_decide = True

    def bind(self, model: mujoco.MjModel) -> None:
        self._feet = [model.geom(f"{leg}_foot").id for leg in LEGS]
        self._dry = model.geom_friction[self._feet, 0].copy()

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        beyond = data.geom_xpos[self._feet, :2] @ self._direction - self._begin
        oily = np.clip(beyond / self.EDGE + 0.5, 0.0, 1.0)
        model.geom_friction[self._feet, 0] = self._dry * (1.0 - (1.0 - self.size) * oily)


class MisreadSlope(HiddenEffect):
    """A board that is tilted otherwise than noted."""

    strong, weak = 0.05, 0.018  # rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        angle = rng.uniform(-math.pi, math.pi)
        self._slope = (self.size * math.cos(angle), self.size * math.sin(angle))
        self.truth = {"roll_rad": self._slope[0], "pitch_rad": self._slope[1]}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.slope = self._slope


class TautCable(HiddenEffect):
    """A springy cable from the trunk to a post on the board: a pull along the ground, less as the robot gives way."""

    strong, weak = 0.9, 0.35  # N, at the start

    LENGTH = 1.5  # m, to the post
    SPRING = 0.15  # N/m

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        heading = rng.uniform(-math.pi, math.pi)
        self._post = self.LENGTH * np.array([math.cos(heading), math.sin(heading)])
        self.truth = {"x_n": self.size * math.cos(heading), "y_n": self.size * math.sin(heading)}

    def bind(self, model: mujoco.MjModel) -> None:
        self._trunk = model.body("base_link").id

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        way = self._post - data.qpos[:2]
        length = float(np.hypot(*way))
        pull = max(self.size + self.SPRING * (length - self.LENGTH), 0.0)
        data.xfrc_applied[self._trunk, :2] += way * (pull / length)
