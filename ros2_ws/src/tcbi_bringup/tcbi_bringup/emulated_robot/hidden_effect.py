"""What a hidden effect may change: hooks that the physics calls, each of which leaves the robot as it is by default.

An effect overrides those hooks that its mechanism touches; several in one robot are asked one after another.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden_names import STRENGTHS
from tcbi_bringup.emulated_robot.mechanics import Build

SIZE_SCATTER = 0.15  # of the effect's size between robots of one strength


class HiddenEffect:
    """An effect of this robot. `rng` draws its size and place; everything after that is mechanics.

    Attributes:
      truth: name -> value with its unit in the name, for whoever may open the envelope.
      polls_behind: turns of the sensors' board that a reading is old when it is stamped.
    """

    strong: float
    weak: float

    def __init__(self, strength: str, rng: np.random.Generator):
        nominal = self.strong if strength == STRENGTHS[0] else self.weak
        self.size = nominal * float(np.exp(rng.normal(0.0, SIZE_SCATTER)))
        self.truth: dict[str, object] = {}
        self.polls_behind = 0

    def uses(self, hook: str) -> bool:
        """Whether this effect overrides a hook."""
        return getattr(type(self), hook) is not getattr(HiddenEffect, hook)

    def attach(self, build: Build, drawing: Drawing) -> None:
        """Change the mechanics before the robot is built."""

    def bind(self, model: mujoco.MjModel) -> None:
        """Look up what `act` works on in the compiled robot and its ground."""

    def reset(self, position: np.ndarray) -> None:
        """Forget the past; the joints stand at `position` (J,) rad."""

    def bus_delay(self, rng: np.random.Generator) -> float:
        """Seconds that a packet of goals waits on its way to the servos; infinite where it is lost."""
        return 0.0

    def hear(self, goals: list[tuple[int, float]], fresh: bool, rng: np.random.Generator) -> list[tuple[int, float]]:
        """Goals (servo, rad) that the servos take, of those in a packet; `fresh` at the packet's beginning."""
        return goals

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """(J,) N m that the motors give at `velocity` (J,) rad/s, of those that the servos' loops ask for."""
        return torque

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray | None:
        """(J,) N m of a servo's own gears at `velocity` (J,) rad/s, besides the motors' torque; a horn with play, or a
        link that bends, comes behind these."""
        return None

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Change contacts or add forces to the compiled robot, before each turn of the servos' loops."""

    def mount(self, motion: np.ndarray, dt: float) -> np.ndarray:
        """(6,) what the IMU undergoes where the trunk undergoes `motion`: rad/s, then m/s^2 with gravity."""
        return motion

    def gyro(self, rate: np.ndarray, time: float) -> np.ndarray:
        """(3,) rad/s that the gyroscope's registers hold at `time` (s), of what they should."""
        return rate

    def supply(self) -> float:
        """Volts that the servos get, over those of a battery without load."""
        return 1.0

    def warmth(self) -> np.ndarray | float:
        """(J,) K by which the servos are warmer than their load explains."""
        return 0.0


class Several(HiddenEffect):
    """More than one effect in one robot, or none."""

    strong = weak = 0.0

    def __init__(self, strength: str, rng: np.random.Generator, effects: Sequence[tuple[str, HiddenEffect]]):
        super().__init__(strength, rng)
        self._all = [effect for _, effect in effects]
        self.truth = {name: effect.truth for name, effect in effects}
        self.polls_behind = sum(effect.polls_behind for effect in self._all)

    def uses(self, hook: str) -> bool:
        return any(effect.uses(hook) for effect in self._all)

    def attach(self, build: Build, drawing: Drawing) -> None:
        for effect in self._all:
            effect.attach(build, drawing)

    def bind(self, model: mujoco.MjModel) -> None:
        for effect in self._all:
            effect.bind(model)

    def reset(self, position: np.ndarray) -> None:
        for effect in self._all:
            effect.reset(position)

    def bus_delay(self, rng: np.random.Generator) -> float:
        return sum(effect.bus_delay(rng) for effect in self._all)

    def hear(self, goals: list[tuple[int, float]], fresh: bool, rng: np.random.Generator) -> list[tuple[int, float]]:
        for effect in self._all:
            goals = effect.hear(goals, fresh, rng)
        return goals

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        for effect in self._all:
            torque = effect.drive(torque, velocity)
        return torque

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray | None:
        torques = [torque for effect in self._all if (torque := effect.resist(velocity, dt)) is not None]
        return sum(torques[1:], torques[0]) if torques else None

    def act(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for effect in self._all:
            effect.act(model, data)

    def mount(self, motion: np.ndarray, dt: float) -> np.ndarray:
        for effect in self._all:
            motion = effect.mount(motion, dt)
        return motion

    def gyro(self, rate: np.ndarray, time: float) -> np.ndarray:
        for effect in self._all:
            rate = effect.gyro(rate, time)
        return rate

    def supply(self) -> float:
        return float(np.prod([effect.supply() for effect in self._all]))

    def warmth(self) -> np.ndarray | float:
        return sum(effect.warmth() for effect in self._all)
