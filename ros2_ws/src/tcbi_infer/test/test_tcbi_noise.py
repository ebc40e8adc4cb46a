"""The sensors' noise: what recordings show of it, and what simulated readings get."""

import dataclasses

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts, hexapod_rollouts

from tcbi_infer.statistics import RolloutArrays, averaged, from_measurements
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.rollouts import AVERAGE_S, TURNING_S, noisier, sensor_noise
from tcbi_infer.tcbi.simulated import with_noise
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model
from tcbi_sim.rig import Noise
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import add_noise, tilted

SIGMA = 0.05  # rad


def with_joint_noise(measurements: list[Measurement], sigma: float) -> list[Measurement]:
    rng = np.random.default_rng(0)
    return [
        dataclasses.replace(m, joint_position=m.joint_position + sigma * rng.standard_normal(m.joint_position.shape))
        for m in measurements
    ]


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_recordings_show_the_noise_of_attitudes_at_any_tilt(tilt: float, sigma: float) -> None:
    rig, rng = load_rig("hexapod"), np.random.default_rng(0)
    noise = dataclasses.replace(rig.noise, attitude=sigma)
    recorded = [add_noise(m, noise, rng) for m in hexapod_rollouts("gait:steps", tilt=tilt, duration=4.0)]
    found = sensor_noise(recorded, dataclasses.replace(rig.noise, attitude=1.0)).attitude
    assert found == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("every", [2, 3])
def test_motion_that_was_sampled_slowly_is_not_taken_for_noise_and_noise_is(every: int) -> None:
    rig, rng = load_rig("hexapod"), np.random.default_rng(0)
    walking = hexapod_rollouts("gait:tripod", duration=4.0)
    slow = [m.resampled(m.time[::every]) for m in walking]
    assert sensor_noise([add_noise(m, rig.noise, rng) for m in slow], rig.noise).joint_position <= 0.0008
    loud = dataclasses.replace(rig.noise, joint_position=0.1, encoder_step=0.0)
    assert sensor_noise([add_noise(m, loud, rng) for m in slow], rig.noise).joint_position > 0.08


def test_the_noise_of_attitudes_is_seen_where_roll_passes_half_a_turn() -> None:
    rng, tipped = np.random.default_rng(0), hexapod_rollouts("gait:steps", duration=4.0)
    over = [dataclasses.replace(m, attitude=m.attitude[:, [1, 0, 3, 2]] * [-1, 1, 1, -1]) for m in tipped]
    recorded = [add_noise(m, Noise(0.0, attitude=0.003), rng) for m in over]
    assert sensor_noise(recorded, Noise(1.0, attitude=1.0)).attitude == pytest.approx(0.003, rel=0.15)


def test_simulated_readings_get_the_trackers_noise_and_the_encoders_steps() -> None:
    rig, rng, clean = load_rig("hexapod"), np.random.default_rng(0), hexapod_rollouts("gait:steps", duration=4.0)
    problem = Problem.of(base_model("hexapod"), [add_noise(m, rig.noise, rng) for m in clean], timestep=0.01)
    assert problem.noise.position == pytest.approx(rig.noise.position, rel=0.15)
    assert problem.noise.encoder_step == rig.noise.encoder_step
    arrays = problem.groups[0].arrays
    seen = with_noise(arrays, problem.noise, [np.random.default_rng(1)])
    assert (seen.position - arrays.position).std() == pytest.approx(problem.noise.position, rel=0.05)
    steps = seen.joint_position / rig.noise.encoder_step
    assert np.allclose(steps, np.round(steps), atol=1e-9)


def test_recordings_without_a_trackers_noise_or_steps_get_none_and_noisier_trackers_are_said() -> None:
    nominal, clean = load_rig("hexapod").noise, hexapod_rollouts("gait:steps", duration=4.0)
    found = sensor_noise(clean, nominal)
    assert found.encoder_step == 0 and found.position < 1e-4
    recorded = [add_noise(m, Noise(0.0, position=0.01), np.random.default_rng(0)) for m in clean]
    found = sensor_noise(recorded, nominal)
    assert found.position == pytest.approx(0.01, rel=0.15)
    assert any(line.startswith("positions are recorded with a noise of 0.0") for line in noisier(found, nominal))


def test_simulated_readings_get_the_noise_that_is_left_of_the_recordings_between_their_stamps() -> None:
    """Stamps at random phases of the grid: 2/3 of the variance on average, here what these phases leave."""
    nominal, rng = load_rig("hexapod").noise, np.random.default_rng(0)
    noise, clean = dataclasses.replace(nominal, encoder_step=0.0), hexapod_rollouts("gait:steps", count=4, duration=2.0)
    stamps = [m.time + rng.uniform(0.0, 0.02, len(m.time)) for m in clean]
    clean = [m.resampled(np.sort(time)) for m, time in zip(clean, stamps, strict=True)]
    recorded = [add_noise(m, noise, rng) for m in clean]
    problem, quiet = (Problem.of(base_model("hexapod"), ms, loop="open", timestep=0.01) for ms in (recorded, clean))
    real, smooth = problem.groups[0].arrays, quiet.groups[0].arrays
    seen, still = (
        dataclasses.replace(problem, noise=n).rollouts(np.full((1, 3), 0.5))[0][0] for n in (noise, Noise(0.0))
    )
    for name in ("joint_position", "roll_pitch", "angular_velocity", "position"):
        left = (getattr(real, name) - getattr(smooth, name))[..., :2].std()
        given = (getattr(seen, name) - getattr(still, name))[..., :2].std()
        assert given == pytest.approx(left, rel=0.1), name
        assert left < 0.9 * getattr(noise, "attitude" if name == "roll_pitch" else name), name
    assert problem.noise.position == pytest.approx(noise.position, rel=0.1), "what a controller reads has all of it"


def test_recordings_noisier_than_the_rig_get_simulated_readings_as_noisy_and_that_is_said() -> None:
    model, measurements = bench_rollouts()
    noisy = with_joint_noise(measurements, SIGMA)
    assert Problem.of(model, noisy, timestep=0.01).noise.joint_position == pytest.approx(SIGMA, rel=0.05)
    (line,) = (line for line in Problem.of(model, noisy, timestep=0.01).warnings if "recorded with a noise of" in line)
    assert line.endswith("simulated readings get as much, and both are averaged over 0.1 s")
    quiet = Problem.of(model, measurements, timestep=0.01)
    assert quiet.noise.joint_position <= 3 * load_rig("servo_bench").noise.joint_position
    assert not any("recorded with a noise" in line for line in quiet.warnings) and quiet.noisy == ()


def test_noisy_recordings_and_their_simulations_are_averaged_alike() -> None:
    model, measurements = bench_rollouts()
    noisy = with_joint_noise(measurements, SIGMA)
    problem, quiet = (Problem.of(model, ms, timestep=0.01) for ms in (noisy, measurements))
    assert problem.noisy == ("joint_position",)
    for seen, still in (
        (problem.groups[0].arrays, quiet.groups[0].arrays),
        (problem.rollouts(np.array([BENCH_TRUTH]))[0][0], quiet.rollouts(np.array([BENCH_TRUTH]))[0][0]),
    ):
        smooth = averaged(still, ("joint_position",), AVERAGE_S, TURNING_S)
        left = (seen.joint_position - smooth.joint_position)[:, :, 3:-3].std()
        assert left == pytest.approx(SIGMA / 3, rel=0.15), "nine samples of 100 Hz"


def test_a_mean_over_neighbours_keeps_rotations_and_what_is_missing() -> None:
    (m,) = hexapod_rollouts("balance", count=1)
    time = np.arange(0.0, 1.0, 0.02)
    arrays = dataclasses.replace(from_measurements([m], time), angular_velocity=None)
    flipped = arrays.attitude.copy()
    flipped[:, :, 20:] *= -1
    gap = arrays.joint_position.copy()
    gap[:, :, 10] = np.nan
    both = ("joint_position", "attitude")
    plain = averaged(arrays, both, AVERAGE_S, TURNING_S)
    found = averaged(dataclasses.replace(arrays, attitude=flipped, joint_position=gap), both, AVERAGE_S, TURNING_S)
    assert np.allclose(found.roll_pitch, plain.roll_pitch) and np.allclose(np.linalg.norm(found.attitude, axis=-1), 1.0)
    assert np.isnan(found.joint_position[:, :, 10]).all() and np.isfinite(np.delete(found.joint_position, 10, 2)).all()
    mean = sum(arrays.joint_position[:, :, k : k + 46] for k in range(5)) / 5
    assert np.allclose(plain.joint_position[:, :, 2:-2], mean)
    assert np.array_equal(averaged(arrays, both, 0.02, 0.02).joint_position, arrays.joint_position), (
        "of one sample each"
    )


def test_attitudes_are_turned_along_by_the_body_rates_before_they_are_averaged() -> None:
    measurements = hexapod_rollouts("balance", duration=3.0)
    clean = from_measurements(measurements, np.arange(0.0, 3.0, 0.02))
    noisy = dataclasses.replace(clean, attitude=tilted(clean.attitude, SIGMA, np.random.default_rng(0)))

    def error(arrays: RolloutArrays) -> float:
        found = averaged(arrays, ("attitude",), AVERAGE_S, TURNING_S)
        return float((found.roll_pitch - clean.roll_pitch).std())

    with_rates, without = error(noisy), error(dataclasses.replace(noisy, angular_velocity=None))
    assert error(clean) < 0.001 and with_rates < 0.45 * without, "of 50 samples, and of 5"
    gap = clean.angular_velocity.copy()
    gap[:, :, 70] = np.nan
    assert error(dataclasses.replace(noisy, angular_velocity=gap)) < 1.2 * with_rates
