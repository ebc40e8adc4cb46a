"""What the robot's sensors make of its motion: encoders, an IMU with attitude fusion, and bouncing foot switches.

Every random number of a sensor comes from the generator that it was given, so that two trials of one motion differ by
it.
"""

import math

import numpy as np

from tcbi_bringup.emulated_robot.servos import STEP

GRAVITY = 9.81
POLL_TICKS = 3  # between two turns of a board that reads its sensors ahead of time


class Encoders:
    """12 bit magnetic encoders whose last bit flickers."""

    FLICKER = 0.4 * STEP  # rad

    def __init__(self, rng: np.random.Generator):
        self._rng = rng

    def read(self, position: np.ndarray) -> np.ndarray:
        """(J,) rad, whole steps."""
        return np.rint((position + self._rng.normal(0.0, self.FLICKER, position.shape)) / STEP) * STEP


class Imu:
    """A MEMS gyroscope and accelerometer with low-pass filters, and the attitude that the chip's fusion makes of them.

    The gyroscope is calibrated at rest when the robot is switched on: what is left of its bias wanders slowly. The
    fusion integrates the gyroscope and corrects roll and pitch towards the accelerometer; nothing corrects yaw.
    """

    FILTER_TIME_S = 2e-3
    FUSION_PERIOD_S = 5e-3
    FUSION_GAIN = 0.15  # 1/s, towards the accelerometer
    GRAVITY_TIME_S = 0.1  # over which the fusion averages the accelerometer before it believes it
    GYRO_STEP = math.radians(1 / 65.5)  # rad/s, +-500 degrees/s in 16 bit
    GYRO_NOISE = 0.006  # rad/s
    GYRO_BIAS, GYRO_BIAS_TIME_S = 2e-4, 60.0  # rad/s
    ACCELERATION_STEP = 2 * 4 * GRAVITY / 65536  # m/s^2, +-4 g in 16 bit
    ACCELERATION_NOISE = 0.05  # m/s^2
    ACCELERATION_BIAS = 0.01  # m/s^2, of this robot
    ATTITUDE_STEP = 2.0**-14

    def __init__(self, robot: np.random.Generator, trial: np.random.Generator, tick_s: float):
        self._rng, self._tick = trial, tick_s
        self._share = 1.0 - math.exp(-tick_s / self.FILTER_TIME_S)
        self._every = round(self.FUSION_PERIOD_S / tick_s)
        self._acceleration_bias = robot.normal(0.0, self.ACCELERATION_BIAS, 3)
        self._bias = trial.normal(0.0, self.GYRO_BIAS, 3)
        self._filtered = np.zeros(6)
        self._scratch = np.zeros(6)
        self._count = 0
        self._gravity = [0.0, 0.0, GRAVITY]
        self._attitude = np.array([1.0, 0.0, 0.0, 0.0])

    def reset(self, attitude: np.ndarray, acceleration: np.ndarray) -> None:
        """Start at rest at a known attitude (4,) w x y z; acceleration (3,) m/s^2 in `imu_link`."""
        self._attitude = np.array(attitude, float)
        self._filtered[:3], self._filtered[3:] = 0.0, acceleration
        self._gravity = (acceleration + self._acceleration_bias).tolist()
        self._count = 0

    def tick(self, motion: np.ndarray) -> None:
        """One tick of the chip: (6,) true angular velocity (rad/s), then acceleration (m/s^2) with gravity."""
        scratch = self._scratch
        np.subtract(motion, self._filtered, out=scratch)
        np.multiply(scratch, self._share, out=scratch)
        np.add(self._filtered, scratch, out=self._filtered)
        self._count += 1
        if self._count == self._every:
            self._count = 0
            self._fuse()

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Attitude (4,) w x y z, angular velocity (3,) rad/s, linear acceleration (3,) m/s^2."""
        gyro = self._filtered[:3] + self._bias + self._rng.normal(0.0, self.GYRO_NOISE, 3)
        acceleration = self._filtered[3:] + self._acceleration_bias
        acceleration += self._rng.normal(0.0, self.ACCELERATION_NOISE, 3)
        attitude = np.rint(self._attitude / self.ATTITUDE_STEP) * self.ATTITUDE_STEP
        return (
            attitude / np.linalg.norm(attitude),
            np.rint(gyro / self.GYRO_STEP) * self.GYRO_STEP,
            np.rint(acceleration / self.ACCELERATION_STEP) * self.ACCELERATION_STEP,
        )

    def _fuse(self) -> None:
        dt = self.FUSION_PERIOD_S
        noise = self._rng.normal(size=9).tolist()
        wander = self.GYRO_BIAS * math.sqrt(2 * dt / self.GYRO_BIAS_TIME_S)
        self._bias = self._bias * (1.0 - dt / self.GYRO_BIAS_TIME_S) + wander * np.array(noise[6:])
        rate = [v + b + self.GYRO_NOISE * n for v, b, n in zip(self._filtered, self._bias, noise[:3], strict=False)]
        force = [
            v + b + self.ACCELERATION_NOISE * n
            for v, b, n in zip(self._filtered[3:], self._acceleration_bias, noise[3:6], strict=True)
        ]
        share = dt / self.GRAVITY_TIME_S
        self._gravity = [g + share * (f - g) for g, f in zip(self._gravity, force, strict=True)]
        w, x, y, z = self._attitude.tolist()
        ax, ay, az = self._gravity
        ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        gain = self.FUSION_GAIN / max(math.sqrt(ax * ax + ay * ay + az * az), 1e-9)
        rate[0] += gain * (ay * uz - az * uy)
        rate[1] += gain * (az * ux - ax * uz)
        rate[2] += gain * (ax * uy - ay * ux)
        h = 0.5 * dt
        p, q, r = rate
        turned = np.array(
            [
                w - h * (p * x + q * y + r * z),
                x + h * (p * w + r * y - q * z),
                y + h * (q * w - r * x + p * z),
                z + h * (r * w + q * x - p * y),
            ]
        )
        self._attitude = turned / np.linalg.norm(turned)


class FootSwitches:
    """Six spring-loaded switches under the feet: closed above a force, open below a lower one, bouncing after a change.

    Args:
      threshold: (6,) N at which they close.
      rng: of the bouncing.
      tick_s: s between two ticks.
    """

    PLUNGER_TIME_S = 3e-3  # the plunger's inertia; chatter of a scrubbing foot does not reach the contact
    RELEASE = 0.6  # of the closing force
    BOUNCE_S = 2e-3  # mean time of bouncing after a change

    def __init__(self, threshold: np.ndarray, rng: np.random.Generator, tick_s: float):
        self._close, self._open, self._rng = threshold, self.RELEASE * threshold, rng
        self._share = 1.0 - math.exp(-tick_s / self.PLUNGER_TIME_S)
        self._level = self._close.copy()
        self._closed = np.zeros(len(threshold), bool)
        self._bouncing = np.zeros(len(threshold))
        self._force, self._scratch = np.zeros(len(threshold)), np.zeros(len(threshold))

    def reset(self) -> None:
        """All open and quiet."""
        self._closed = np.zeros(len(self._closed), bool)
        self._level = self._close.copy()
        self._bouncing[:] = 0.0
        self._force[:] = 0.0

    def tick(self, force: np.ndarray, time: float) -> None:
        """One tick: (6,) N on the feet at `time` (s)."""
        scratch = self._scratch
        np.subtract(force, self._force, out=scratch)
        np.multiply(scratch, self._share, out=scratch)
        np.add(self._force, scratch, out=self._force)
        closed = self._force > self._level
        if closed.tobytes() != self._closed.tobytes():
            changed = closed != self._closed
            self._closed = closed
            self._level = np.where(closed, self._open, self._close)
            fresh = time + self._rng.exponential(self.BOUNCE_S, len(closed))
            self._bouncing = np.where(changed, fresh, self._bouncing)

    def read(self, time: float) -> np.ndarray:
        """(6,) bool; while a switch bounces it says either."""
        chatter = self._rng.random(len(self._closed)) < 0.5
        return np.where(self._bouncing > time, chatter, self._closed)
