"""Checks of the IMU against itself: its gyro must turn as its attitude turns, its accelerometer must feel gravity where
that is."""

import numpy as np

from tcbi_sim.measurement import Measurement, continuous

TURNS = np.radians(3.0)  # rad/s, standard deviation of a body rate that counts as motion
WINDOW = 5  # samples averaged over, against noise
MIRRORED, FOLLOWS = -0.6, 0.7  # correlations
GRAVITY = 9.81  # m/s^2
ALONG = 0.7  # cosine; an IMU that was mounted carelessly is not 45 degrees off
AXES = "xyz"


def check_imu(m: Measurement) -> list[str]:
    """Findings about gyro and accelerometer of one recording."""
    return [*_gyro(m), *_accelerometer(m)]


def _gyro(m: Measurement) -> list[str]:
    if m.attitude is None or m.angular_velocity is None or len(m.time) < 4 * WINDOW:
        return []
    turned, felt = body_rates(m.attitude, m.time), (m.angular_velocity[1:] + m.angular_velocity[:-1]) / 2
    kernel = np.ones(WINDOW) / WINDOW
    turned, felt = (np.stack([np.convolve(c, kernel, "valid") for c in v.T], axis=-1) for v in (turned, felt))
    turns, feels = np.std(turned, axis=0), np.std(felt, axis=0)
    if not turns.any() and feels.max() > TURNS:
        return ["The attitude never changes while the gyro turns: it is not measured"]
    if not feels.any() and turns.max() > TURNS:
        return ["The gyro reads the same all the time while the attitude turns: it is not measured"]
    moving = [i for i in range(3) if turns[i] > TURNS and feels[i] > 0]
    if not moving:
        return []
    table = np.corrcoef(turned.T, felt.T)[:3, 3:]
    slope = np.median([np.std(felt[:, i]) / np.std(turned[:, i]) for i in moving])
    findings = []
    if 30 < slope < 100:
        findings.append("The gyro turns 57 times as fast as the attitude: it looks like degrees a second")
    findings += [
        f"The gyro's {AXES[i]} axis turns against the attitude: it may be mirrored"
        for i in moving
        if table[i, i] < MIRRORED
    ]
    findings += [
        f"The gyro's {AXES[i]} and {AXES[j]} axes turn as the attitude does about each other's: they may be swapped"
        for i in moving
        for j in moving
        if i < j
        and min(abs(table[i, j]), abs(table[j, i])) > max(FOLLOWS, max(abs(table[i, i]), abs(table[j, j])) + 0.3)
    ]
    return findings


def body_rates(attitude: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(T - 1, 3) rad/s in the body's frame between neighbouring attitudes (T, 4) w x y z."""
    q = continuous(attitude)
    a, b = q[:-1], q[1:]
    turn = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    return 2.0 * turn / np.diff(time)[:, None]


def _accelerometer(m: Measurement) -> list[str]:
    if m.linear_acceleration is None or len(m.time) < 10:
        return []
    size = float(np.median(np.linalg.norm(m.linear_acceleration, axis=-1)))
    if 0.9 < size < 1.1:
        return ["The accelerometer reads 1 at rest: it looks like multiples of gravity instead of m/s^2"]
    if size < 0.1 * GRAVITY:
        return ["The accelerometer feels no gravity: it was taken out before recording, or the sensor is dead"]
    return [] if m.attitude is None else _direction(m.linear_acceleration, m.attitude)


def _direction(force: np.ndarray, attitude: np.ndarray) -> list[str]:
    """Whether (T, 3) the force felt points, in the mean, up from (T, 4) attitudes w x y z."""
    w, x, y, z = attitude.T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)], axis=-1)
    up, felt = np.nanmean(up, axis=0), np.nanmedian(force, axis=0)
    cosine = float(felt @ up / np.linalg.norm(felt) / np.linalg.norm(up))
    if not cosine <= ALONG:  # NaN where one was never measured
        return []
    if cosine < -ALONG:
        return ["The accelerometer feels gravity the other way up: its sign may be mirrored"]
    return [
        f"The accelerometer feels gravity {np.degrees(np.arccos(cosine)):.0f} deg off where the attitude has it: its "
        "axes may be swapped"
    ]
