"""What a robot may have that nobody told the model: one physical effect, in two strengths.

Each is built from the mechanism itself: bristles that bend before they slip, a motor with its own inertia behind a gap,
a bus whose packets wait, a supply line that droops. An effect overrides those hooks of `HiddenEffect` that its
mechanism touches; all the others leave the robot as it is. To add one, write a class and enter it in `EFFECTS`.
"""

from collections.abc import Mapping

import numpy as np

from tcbi_bringup.emulated_robot.character import JOINT_COUNT
from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.gear import GearGap
from tcbi_bringup.emulated_robot.mechanics import Build, Load
from tcbi_contract.names import LEG_JOINTS, LEGS

STRENGTHS = ("strong", "weak")
SIZE_SCATTER = 0.15  # of the effect's size between robots of one strength
NONE = "none"


class HiddenEffect:
    """An effect of this robot. `rng` draws its size and place; everything after that is mechanics.

    Attributes:
      truth: name -> value with its unit in the name, for whoever may open the envelope.
      gear: the gap between servo and leg, where there is one.
    """

    strong: float
    weak: float

    def __init__(self, strength: str, rng: np.random.Generator):
        nominal = self.strong if strength == "strong" else self.weak
        self.size = nominal * float(np.exp(rng.normal(0.0, SIZE_SCATTER)))
        self.truth: dict[str, float | str] = {}
        self.gear: GearGap | None = None

    def attach(self, build: Build, drawing: Drawing) -> None:
        """Change the mechanics before the robot is built."""

    def reset(self, position: np.ndarray) -> None:
        """Forget the past; the joints stand at `position` (J,) rad."""

    def bus_delay(self, rng: np.random.Generator) -> float:
        """Seconds that a packet of goals waits on its way to the servos."""
        return 0.0

    def drive(self, torque: np.ndarray) -> np.ndarray:
        """(J,) N m that the motors give, of those that the servos' loops ask for."""
        return torque

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray | None:
        """(J,) N m on the joints at `velocity` (J,) rad/s, besides the motors' torque."""
        return None


class BristleFriction(HiddenEffect):
    """Dry friction of the gears in all joints: LuGre bristles (Canudas de Wit et al. 1995).

    Breaking away takes a tenth more than sliding.
    """

    strong, weak = 0.06, 0.025  # N m, sliding

    BENDING = 0.004  # rad that the bristles bend before they slip
    BREAKAWAY = 1.1
    STRIBECK_SPEED = 0.15  # rad/s
    BRISTLE_DAMPING = 0.01  # N m s/rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"sliding_torque_n_m": self.size}
        self._stiffness = self.size / self.BENDING
        self._bend = np.zeros(JOINT_COUNT)

    def reset(self, position: np.ndarray) -> None:
        self._bend[:] = 0.0

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        """Integrates the bristles' deflection exactly over `dt` at constant velocity, so that no step is too long."""
        slow = np.exp(-np.square(velocity / self.STRIBECK_SPEED))
        slip_limit = self.BENDING * (1.0 + (self.BREAKAWAY - 1.0) * slow)
        decay = np.exp(-np.abs(velocity) * (dt / slip_limit))
        before = self._bend
        self._bend = before * decay + np.sign(velocity) * slip_limit * (1.0 - decay)
        return -self._stiffness * self._bend - (self.BRISTLE_DAMPING / dt) * slow * (self._bend - before)


class OilDamping(HiddenEffect):
    """Thick grease in all joints: torque against velocity, a little more than in proportion at speed."""

    strong, weak = 0.10, 0.04  # N m s/rad at rest

    SQUARE_PART = 0.02  # of the coefficient, for each rad/s

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"damping_n_m_s_per_rad": self.size}

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        return -self.size * velocity * (1.0 + self.SQUARE_PART * np.abs(velocity))


class BusDelay(HiddenEffect):
    """Packets of goals wait on a shared radio link, each a little longer or shorter; none overtakes another."""

    strong, weak = 0.070, 0.030  # s, mean

    JITTER = 0.15  # standard deviation over mean

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"latency_s": self.size, "jitter_s": self.size * self.JITTER}

    def bus_delay(self, rng: np.random.Generator) -> float:
        shape = self.JITTER**-2
        return float(rng.gamma(shape, self.size / shape))


class LooseHorns(HiddenEffect):
    """Worn splines between servo and leg in all joints: the motor turns through a gap before its teeth push the leg.

    The encoder sits on the motor's side of the gap. A seventh of the joint's inertia and damping stays at the leg's.
    """

    strong, weak = 0.060, 0.025  # rad, from face to face

    LEG_SHARE = 1 / 7

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"gap_rad": self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        motor = 1.0 - self.LEG_SHARE
        self.gear = GearGap(self.size, motor * build.joint_armature, motor * build.joint_damping, JOINT_COUNT)
        build.joint_armature *= self.LEG_SHARE
        build.joint_damping *= self.LEG_SHARE


class TiredLeg(HiddenEffect):
    """One leg's servos with worn magnets on a corroded supply line: less torque per volt, fewer volts under load."""

    strong, weak = 0.50, 0.25  # share of the torque that is lost without load

    DROOP = 0.08  # of the line's voltage, when all three servos of the leg ask for full torque

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.size = min(self.size, 0.8)
        leg = int(rng.integers(len(LEGS)))
        self._joints = slice(len(LEG_JOINTS) * leg, len(LEG_JOINTS) * (leg + 1))
        self._full = 1.0
        self.truth = {"leg": LEGS[leg], "remaining_torque_share": 1.0 - self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        self._full = len(LEG_JOINTS) * drawing.torque_limit

    def drive(self, torque: np.ndarray) -> np.ndarray:
        asked = torque[self._joints]
        volts = 1.0 - self.DROOP * float(np.abs(asked).sum()) / self._full
        torque[self._joints] = asked * ((1.0 - self.size) * volts)
        return torque


class Backpack(HiddenEffect):
    """A box screwed to the trunk's top, off its middle."""

    strong, weak = 0.20, 0.08  # kg

    SIZE = (0.050, 0.040, 0.030)  # m

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        corner = rng.choice([-1.0, 1.0], 2) * rng.uniform((0.035, 0.015), (0.065, 0.035))
        self._xy = (float(corner[0]), float(corner[1]))
        self.truth = {"mass_kg": self.size, "x_m": self._xy[0], "y_m": self._xy[1]}

    def attach(self, build: Build, drawing: Drawing) -> None:
        height = (drawing.trunk_size[2] + self.SIZE[2]) / 2
        build.loads.append(Load(self.size, (*self._xy, height), self.SIZE))


EFFECTS: Mapping[str, type[HiddenEffect]] = {
    "coulomb_friction": BristleFriction,
    "viscous_damping": OilDamping,
    "command_latency": BusDelay,
    "backlash": LooseHorns,
    "weak_leg": TiredLeg,
    "payload": Backpack,
}


class Nothing(HiddenEffect):
    """Nothing hidden: the model has all the physics of this robot, if not its numbers."""

    strong = weak = 0.0


def choose(name: str | None, strength: str | None, seed: int) -> tuple[str, str, HiddenEffect]:
    """The hidden effect of robot number `seed`: what was named, or drawn from the seed where it was not.

    Raises:
      EmulatedRobotError: an unknown effect or strength.
    """
    names = (*EFFECTS, NONE)
    if name is not None and name not in names:
        raise EmulatedRobotError(f"unknown hidden effect {name!r}; this robot can have {', '.join(names)}")
    if strength is not None and strength not in STRENGTHS:
        raise EmulatedRobotError(f"unknown strength {strength!r}; allowed is {' or '.join(STRENGTHS)}")
    rng = np.random.default_rng([seed, 2])
    drawn = str(rng.choice(list(EFFECTS)))
    name, strength = name or drawn, strength or STRENGTHS[0]
    effect = EFFECTS.get(name, Nothing)
    return name, strength, effect(strength, rng)
