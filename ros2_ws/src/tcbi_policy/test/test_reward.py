"""The reward formula: what each term is worth, and that all its users agree."""

import numpy as np
import pytest

from tcbi_policy.errors import RewardError
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import attitude_error, episode_reward, inclination, progress, simulated_rewards, step_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario, quaternion_from_rpy
from tcbi_sim.model import base_model

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def tilted(roll: float, pitch: float, yaw: float = 0.0) -> np.ndarray:
    return quaternion_from_rpy(np.array(roll), np.array(pitch), np.array(yaw))


def test_one_metre_forward_is_worth_90000() -> None:
    rewards = step_rewards("forward", np.tile(LEVEL, (3, 1)), np.array([0.0, 0.25, 1.0]), np.zeros((2, 18)))
    assert rewards == pytest.approx([0.25 * 90000, 0.75 * 90000])


def test_levelling_one_axis_by_a_degree_is_worth_79_points() -> None:
    degree = np.pi / 180
    attitude = np.stack([tilted(5 * degree, 0), tilted(4 * degree, 0)])
    assert step_rewards("balance", attitude, None, np.zeros((1, 18))) == pytest.approx([9000 * degree / 2])


def test_moving_every_joint_by_half_a_radian_costs_150_and_holding_it_nothing() -> None:
    action = np.full((2, 18), 0.5)
    assert step_rewards("balance", np.tile(LEVEL, (3, 1)), None, action) == pytest.approx([-150.0, 0.0])


def test_the_first_cost_counts_from_the_posture_at_the_start() -> None:
    action = np.full((1, 18), 0.5)
    assert step_rewards("balance", np.tile(LEVEL, (2, 1)), None, action, action[0]) == pytest.approx([0.0])


def test_leading_axes_are_independent() -> None:
    rng = np.random.default_rng(0)
    attitude = tilted(*rng.normal(0, 0.2, (3, 4, 5, 11)))
    moved, action = rng.normal(size=(4, 5, 11)), rng.normal(size=(4, 5, 10, 18))
    together = step_rewards("forward", attitude, moved, action)
    alone = step_rewards("forward", attitude[2, 3], moved[2, 3], action[2, 3])
    assert together.shape == (4, 5, 10)
    np.testing.assert_array_equal(together[2, 3], alone)


def test_yaw_is_no_attitude_error_and_inclination_is_the_angle_to_the_vertical() -> None:
    assert attitude_error(tilted(0.0, 0.0, 1.0)) == pytest.approx(0.0)
    assert inclination(tilted(0.3, 0.0, 2.0)) == pytest.approx(0.3)
    assert np.cos(inclination(tilted(0.3, 0.2))) == pytest.approx(np.cos(0.3) * np.cos(0.2))


def test_progress_is_measured_along_the_heading_at_the_start() -> None:
    position = np.array([[1.0, 1.0, 0.0], [1.0, 3.0, 0.5]])
    assert progress(position, np.pi / 2)[-1] == pytest.approx(2.0)
    assert progress(position, 0.0)[-1] == pytest.approx(0.0)


def test_forward_without_position_is_refused() -> None:
    with pytest.raises(RewardError, match="distance at the end"):
        step_rewards("forward", np.tile(LEVEL, (2, 1)), None, np.zeros((1, 18)))


def walk(duration: float = 2.0, task: str = "forward", yaw: float = 0.0) -> Measurement:
    model = base_model("hexapod")
    posture = tuple(np.linspace(-0.1, 0.1, 18))
    scenario = Scenario(task, duration, slope_roll=0.1, initial_joint_position=posture, initial_yaw=yaw)
    out = simulate(model, model.mean()[None], [scenario], controller=Gait("tripod"), timestep=0.01)
    measurement = out.measurement(0)
    rewards = simulated_rewards(out)[0, 0]
    assert episode_reward(measurement).steps == pytest.approx(rewards)
    return measurement


def test_a_rollout_and_its_measurement_have_the_same_rewards_which_sum_to_the_return() -> None:
    reward = episode_reward(walk())
    assert len(reward.steps) == 10
    assert reward.total == pytest.approx(reward.steps.sum())


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_distance_at_the_end_is_enough_for_the_return(yaw: float) -> None:
    """Whichever way the robot faces at the start: a tape measure lies along its heading."""
    from dataclasses import replace

    measurement = walk(yaw=yaw)
    without = episode_reward(replace(measurement, position=None))
    assert np.isnan(without.steps).all()
    assert without.total == pytest.approx(episode_reward(measurement).total)


@pytest.mark.parametrize("lost", [(0.0, 0.3), (1.4, np.inf)])
def test_a_tracker_that_lost_the_robot_at_an_end_gives_way_to_the_distance(lost: tuple[float, float]) -> None:
    from dataclasses import replace

    measurement = walk()
    assert measurement.position is not None
    away = (measurement.time >= lost[0]) & (measurement.time < lost[1])
    held = np.where(away[:, None], measurement.position[~away][0 if lost[0] == 0 else -1], measurement.position)
    nowhere = np.where(away[:, None], np.nan, measurement.position)
    true = episode_reward(measurement).total
    for wrong in (
        replace(measurement, position=held, gaps=(("position", *lost),)),
        replace(measurement, position=nowhere),
    ):
        assert episode_reward(wrong).total == pytest.approx(true)
        assert np.isnan(episode_reward(replace(wrong, distance=np.nan)).total)


def test_neither_position_nor_distance_leaves_the_return_unknown() -> None:
    from dataclasses import replace

    assert np.isnan(episode_reward(replace(walk(), position=None, distance=np.nan)).total)


def test_a_rollout_without_attitude_or_commands_has_no_reward() -> None:
    from dataclasses import replace

    measurement = walk(0.4, "balance")
    with pytest.raises(RewardError, match="no attitude"):
        episode_reward(replace(measurement, attitude=None))
    with pytest.raises(RewardError, match="no commands"):
        episode_reward(replace(measurement, commands=Commands(np.zeros(0), np.zeros((0, 18)))))
