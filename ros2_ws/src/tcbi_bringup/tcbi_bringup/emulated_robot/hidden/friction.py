"""What the joints rub on: teeth and bristles that bend before they slip, grease, loaded teeth."""

import numpy as np

from tcbi_bringup.emulated_robot.character import JOINT_COUNT
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect


class SlippingTeeth(HiddenEffect):
    """Dry friction of the gears in all joints: springs in parallel that let go one after another (Maxwell slip).

    As in Al-Bender, Lampaert and Swevers, The generalized Maxwell-slip model, IEEE Transactions on Automatic Control 50
    (2005). Breaking away takes a tenth more than sliding.
    """

    strong, weak = 0.06, 0.025  # N m, sliding

    SLIP = np.array([0.0012, 0.0025, 0.005, 0.010])[:, None]  # rad, at which each spring lets go; they share the torque
    BREAKAWAY = 1.1
    STRIBECK_SPEED = 0.15  # rad/s
    GREASE = 0.002  # N m s/rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"sliding_torque_n_m": self.size}
        self._stiffness = self.size / len(self.SLIP) / self.SLIP
        self._bend = np.zeros((len(self.SLIP), JOINT_COUNT))

    def reset(self, position: np.ndarray) -> None:
        self._bend[:] = 0.0

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        """Exact over `dt` at constant velocity, so that no step is too long."""
        limit = self.SLIP * (1.0 + (self.BREAKAWAY - 1.0) * np.exp(-np.square(velocity / self.STRIBECK_SPEED)))
        self._bend = np.clip(self._bend + velocity * dt, -limit, limit)
        return -(self._stiffness * self._bend).sum(axis=0) - self.GREASE * velocity


class OilDamping(HiddenEffect):
    """Thick grease in all joints: torque against velocity, a little more than in proportion at speed."""

    strong, weak = 0.10, 0.04  # N m s/rad at rest

    SQUARE_PART = 0.02  # of the coefficient, for each rad/s

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"damping_n_m_s_per_rad": self.size}

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        return -self.size * velocity * (1.0 + self.SQUARE_PART * np.abs(velocity))


class Bristles:
    """Bristles of one stiffness under a slip limit (J,) N m that may change from turn to turn."""

    STIFFNESS = 15.0  # N m/rad
    DAMPING = 0.01  # N m s/rad while they bend
    LEAST = 1e-4  # N m, below which no bristle slips

    def __init__(self) -> None:
        self._bend = np.zeros(JOINT_COUNT)

    def reset(self) -> None:
        """Let go."""
        self._bend[:] = 0.0

    def torque(self, velocity: np.ndarray, limit: np.ndarray, dt: float) -> np.ndarray:
        """(J,) N m on the joints; the deflection is exact over `dt` at constant velocity and limit."""
        slip = np.maximum(limit, self.LEAST) / self.STIFFNESS
        decay = np.exp(-np.abs(velocity) * (dt / slip))
        before = self._bend
        self._bend = before * decay + np.sign(velocity) * slip * (1.0 - decay)
        return -self.STIFFNESS * self._bend - (self.DAMPING / dt) * decay * (self._bend - before)


class StickingGears(HiddenEffect):
    """Bristles that hold fast at rest, let go with speed, and are pressed harder by the torque of the motor."""

    strong, weak = 0.06, 0.025  # N m at rest

    SPEED = 0.3  # rad/s, at which that has fallen to 1/e
    LOAD_SHARE = 1.5  # of the motor's torque, for each N m at rest

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self._share = self.LOAD_SHARE * self.size
        self.truth = {"static_torque_n_m": self.size, "speed_rad_s": self.SPEED, "load_share": self._share}
        self._bristles, self._load = Bristles(), np.zeros(JOINT_COUNT)

    def reset(self, position: np.ndarray) -> None:
        self._bristles.reset()

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        self._load = np.abs(torque)
        return torque

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        limit = self.size * np.exp(-np.square(velocity / self.SPEED)) + self._share * self._load
        return self._bristles.torque(velocity, limit, dt)


class LossyGears(HiddenEffect):
    """Gears that lose a share of the torque between motor and leg, whichever drives the other."""

    strong, weak = 0.25, 0.10  # of the motor's torque

    MESH_S = 4e-3  # in which the teeth take up a new load

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.size = min(self.size, 0.7)
        self.truth = {"lost_share": self.size}
        self._bristles, self._load = Bristles(), np.zeros(JOINT_COUNT)

    def reset(self, position: np.ndarray) -> None:
        self._bristles.reset()
        self._load[:] = 0.0

    def drive(self, torque: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        self._torque = torque
        return torque

    def resist(self, velocity: np.ndarray, dt: float) -> np.ndarray:
        self._load += dt / self.MESH_S * (np.abs(self._torque) - self._load)
        return self._bristles.torque(velocity, self.size * self._load, dt)
