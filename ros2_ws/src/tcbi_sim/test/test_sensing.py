"""Late sensors: what arrives is what the joints did before, between two samples, too."""

import numpy as np

from tcbi_sim.sensing import Samples, delay

RATE = 50.0


def turning(time: np.ndarray) -> np.ndarray:
    return 0.5 * np.sin(2 * np.pi * 1.5 * time)


def samples(count: int = 60) -> Samples:
    time = np.arange(count) / RATE
    angle = turning(time)[None, :, None]
    half = angle / 2
    attitude = np.concatenate([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=-1)
    return Samples(time, angle, attitude, None, None, None, None)


def test_angles_between_samples_do_not_cut_corners():
    seen, latency = samples(), np.array([0.013])
    late = delay(seen, latency, seen.time[10:])
    true = turning(seen.time[10:] - 0.013)
    straight = np.interp(seen.time[10:] - 0.013, seen.time, turning(seen.time))
    error = np.abs(late.joint_position[0, :, 0] - true).max()
    assert error < 5e-4 and error < 0.1 * np.abs(straight - true).max()
    assert np.abs(2 * np.arctan2(late.attitude[0, :, 1], late.attitude[0, :, 0]) - true).max() < 5e-4


def test_nothing_later_than_a_reading_counts_and_before_the_first_sample_all_stood_still():
    whole, begun = samples(60), samples(31)
    latency = np.array([0.027])
    early = delay(begun, latency, begun.time)
    np.testing.assert_array_equal(early.joint_position, delay(whole, latency, whole.time).joint_position[:, :31])
    assert early.joint_position[0, 0, 0] == turning(np.zeros(1))[0]
    np.testing.assert_array_equal(delay(whole, np.zeros(1), whole.time).joint_position, whole.joint_position)
