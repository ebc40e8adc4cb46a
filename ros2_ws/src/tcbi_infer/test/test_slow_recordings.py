"""A recording slower than the rig's rate: what is interpolated between its readings is no measurement."""

import dataclasses

import bench_recordings
import numpy as np
import pytest
from bench_recordings import BASE, NOISE, record

from tcbi_infer.compare import compare
from tcbi_infer.compare.noise import autocorrelation_time
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose.settings import QUICK
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model

MODEL = base_model("servo_bench")


def true_model() -> Model:
    return MODEL.with_particles(np.tile(BASE, (2, 1)))


@pytest.fixture(scope="module")
def motion() -> list[Measurement]:
    """Seven motions without noise."""
    noise, bench_recordings.NOISE = NOISE, 0.0
    try:
        return record(MODEL, BASE, repeats=1)
    finally:
        bench_recordings.NOISE = noise


def sampled(motion: list[Measurement], rate: float, begins: tuple[float, float] = (0.013, 0.013)) -> list[Measurement]:
    """Every motion twice, read `rate` times a second from some moment on."""
    rng = np.random.default_rng(0)
    rollouts = []
    for m in motion:
        for repeat, begin in enumerate(begins):
            read = m.resampled(np.arange(begin, 5.0, 1.0 / rate), curved=True)
            noisy = read.joint_position + rng.normal(0, NOISE, read.joint_position.shape)
            rollouts.append(dataclasses.replace(read, rollout_id=f"{m.policy_id}_{repeat}", joint_position=noisy))
    return rollouts


@pytest.mark.parametrize(("rate", "most"), [(10.0, 1.5), (23.0, 1.2), (50.0, 1.2)])
def test_the_true_model_errs_by_hardly_more_than_the_noise_of_a_slow_recording(motion, rate, most):
    """A curve through ten readings a second cuts the corners of jumps that last a fifth of a second."""
    found = compare(true_model(), sampled(motion, rate), particles=2)
    (servo,) = [s for s in found.signals if s.name == "servo"]
    assert found.error_over_floor < most
    assert servo.noise_floor == pytest.approx(np.degrees(NOISE), rel=0.15)


def test_repeats_that_read_at_other_moments_are_repeats(motion):
    found = compare(true_model(), sampled(motion, 20.0, (0.013, 0.041)), particles=2)
    (servo,) = [s for s in found.signals if s.name == "servo"]
    assert servo.floor_from == "replicates"
    assert 0.8 < servo.noise_floor / np.degrees(NOISE) < 2.0
    assert found.error_over_floor < 1.4


def test_the_independent_samples_of_a_slow_recording_are_counted_among_its_readings():
    rng = np.random.default_rng(0)
    dense = np.zeros((40, 1000, 1))
    for t in range(1, 1000):
        dense[:, t] = 0.97 * dense[:, t - 1] + rng.normal(size=(40, 1))
    sparse = np.full_like(dense, np.nan)
    sparse[:, ::5] = dense[:, ::5]
    assert autocorrelation_time(sparse) == pytest.approx(autocorrelation_time(dense[:, ::5]), rel=0.05)


def test_only_samples_next_to_readings_are_compared_and_pictures_show_all(motion):
    replay = Replay.of(MODEL, sampled(motion, 10.0))
    per_second = np.isfinite(replay.measured[0, :, 0]).sum() / 5.0
    assert per_second == pytest.approx(10.0, abs=0.5)
    assert np.isfinite(replay.shown[0, 3:-10, 0]).all()


def test_readings_half_a_sample_beside_the_grid_count_too(motion):
    replay = Replay.of(MODEL, sampled(motion, 50.0, (0.0149, 0.0149)))
    assert np.isfinite(replay.measured[0, :, 0]).mean() > 0.45


def test_nothing_is_missing_in_a_slow_recording_of_the_model_itself(motion):
    found = diagnose(MODEL, sampled(motion, 10.0), uses=["backlash", "command_latency"], settings=QUICK)
    assert found.verdict == "nothing_missing"
