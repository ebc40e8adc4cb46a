"""What the motors cannot give: a tired leg, a battery, heat, currents that are limited, voltage used up by speed."""

import numpy as np

from tcbi_bringup.emulated_robot.character import JOINT_COUNT
from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.mechanics import Build
from tcbi_bringup.emulated_robot.servos import LOOP_PERIOD_S
from tcbi_contract.names import LEG_JOINTS, LEGS


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

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        asked = torque[self._joints]
        volts = 1.0 - self.DROOP * float(np.abs(asked).sum()) / self._full
        torque[self._joints] = asked * ((1.0 - self.size) * volts)
        return torque


class MotorEffect(HiddenEffect):
    """An effect that knows the servos' full torque `stall`, N m."""

    stall = 1.0

    def attach(self, build: Build, drawing: Drawing) -> None:
        self.stall = drawing.torque_limit


class OldBattery(MotorEffect):
    """A battery with inner resistance and one RC pair: volts fall with the current of all motors together.

    Of a steady current's drop a fifth comes at once, the rest with the pair's time constant.
    """

    strong, weak = 0.65, 0.30  # of the voltage, if every servo stalled for long

    AT_ONCE = 0.2
    TIME_S = 0.4

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.size = min(self.size, 0.85)
        self.truth = {"drop_at_stall": self.size, "time_constant_s": self.TIME_S}
        self._charge, self._volts = 0.0, 1.0  # of the pair's capacitor, and at the terminals, over the open circuit's

    def reset(self, position: np.ndarray) -> None:
        self._charge, self._volts = 0.0, 1.0

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        duty = float(np.abs(torque).sum()) / (self.stall * JOINT_COUNT)
        current = duty * self._volts  # of the stall current of all, as the volts of the turn before drive it
        slow = (1.0 - self.AT_ONCE) * self.size
        self._charge += LOOP_PERIOD_S / self.TIME_S * (slow * current - self._charge)
        self._volts = 1.0 - self._charge - self.AT_ONCE * self.size * current
        torque *= self._volts
        return torque

    def supply(self) -> float:
        return self._volts


class HotWindings(MotorEffect):
    """Windings in their cases (two heat capacities): a warm winding draws less current, and its magnet is weaker.

    Warmth is counted as the torque that it costs, over the torque that is left.
    """

    strong, weak = 0.50, 0.20  # of the torque, lost in a second at full torque

    WINDING_TIME_S = 30.0  # winding to case
    CASE_TIME_S = 240.0  # case to air
    CASE_CAPACITY = 6.0  # of the windings'
    KELVIN = 250.0  # that cost as much torque as is left

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"loss_per_s_at_stall": self.size, "winding_time_s": self.WINDING_TIME_S}
        self._winding, self._case = np.zeros(JOINT_COUNT), np.zeros(JOINT_COUNT)

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Placing the robot does not cool it: nothing is reset."""
        load = torque / self.stall
        flow = (self._winding - self._case) / self.WINDING_TIME_S
        self._winding += LOOP_PERIOD_S * (self.size * np.square(load) - flow)
        self._case += LOOP_PERIOD_S * (flow / self.CASE_CAPACITY - self._case / self.CASE_TIME_S)
        torque /= 1.0 + self._winding
        return torque

    def warmth(self) -> np.ndarray:
        return self.KELVIN * self._case


class CurrentLimit(MotorEffect):
    """Drivers that fold back well below the sheet's stall current, with a rounded knee."""

    strong, weak = 0.30, 0.45  # of the sheet's stall torque that is left

    KNEE = 8.0  # the higher, the sharper

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"remaining_torque_share": self.size}

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        over = np.square(torque / (self.size * self.stall)) ** (self.KNEE / 2)
        torque /= (1.0 + over) ** (1.0 / self.KNEE)
        return torque


class BackEmf(MotorEffect):
    """Motors whose turning makes a voltage against the supply's; the loop's current controller has no more than that.

    The current follows the voltage through the winding's inductance.
    """

    strong, weak = 0.40, 0.28  # s/rad, one over the speed without load

    WINDING_S = 5e-4  # inductance over resistance

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"slowness_s_per_rad": self.size}
        self._current = np.zeros(JOINT_COUNT)
        self._share = 1.0 - float(np.exp(-LOOP_PERIOD_S / self.WINDING_S))

    def reset(self, position: np.ndarray) -> None:
        self._current[:] = 0.0

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        emf = self.size * velocity  # of the supply's voltage
        duty = np.clip(torque / self.stall + emf, -1.0, 1.0)
        self._current += self._share * (duty - emf - self._current)
        np.multiply(np.clip(self._current, -1.0, 1.0), self.stall, out=torque)
        return torque
