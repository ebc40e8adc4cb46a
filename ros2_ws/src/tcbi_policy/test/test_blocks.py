"""Who went over a block: seen from above, on any slope and for any turn of the block."""

import dataclasses

import numpy as np
import pytest

from tcbi_policy.artefact import find_policy
from tcbi_policy.blocks import OverBlocks, blocks_under, feet, over_blocks, time_past
from tcbi_policy.evaluation import Evaluation, draw_conditions, evaluate
from tcbi_policy.kinematics import neutral_feet
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Block, Scenario, quaternion_from_rpy
from tcbi_sim.model import base_model

BLOCK = Block((1.0, 0.3, 0.035), (0.2, 0.1, 0.07))


def with_blocks(*blocks: Block, slope_pitch: float = 0.0) -> Scenario:
    return Scenario("forward", 30.0, slope_pitch=slope_pitch, blocks=blocks)


def straight(y: float, to: float = 2.0) -> np.ndarray:
    """A path (T, 3) along x at a distance y from the middle."""
    x = np.linspace(0.0, to, 400)
    return np.stack([x, np.full_like(x, y), np.full_like(x, 0.11)], axis=-1)


def came_over(points: np.ndarray, scenario: Scenario) -> bool:
    return bool(blocks_under(points, scenario).any())


def test_a_path_across_a_block_is_over_it_and_one_beside_or_short_of_it_is_not() -> None:
    assert came_over(straight(0.3), with_blocks(BLOCK))
    assert came_over(straight(0.349), with_blocks(BLOCK)) and not came_over(straight(0.351), with_blocks(BLOCK))
    assert not came_over(straight(0.3, to=0.89), with_blocks(BLOCK))
    assert came_over(straight(0.3), with_blocks(dataclasses.replace(BLOCK, center=(9.0, 0.0, 0.0)), BLOCK))
    assert not came_over(straight(0.3), with_blocks())


def test_each_block_under_a_path_counts_once() -> None:
    beyond = dataclasses.replace(BLOCK, center=(1.5, 0.3, 0.035))
    beside = dataclasses.replace(BLOCK, center=(1.5, -0.3, 0.035))
    assert blocks_under(straight(0.3), with_blocks(BLOCK, beside, beyond)).tolist() == [True, False, True]


def test_a_turned_block_has_its_edges_where_it_is_turned_to() -> None:
    turned = with_blocks(dataclasses.replace(BLOCK, yaw=np.pi / 2))
    assert came_over(straight(0.39), turned) and not came_over(straight(0.39), with_blocks(BLOCK))
    end = np.array([[1.0 + 0.099 * np.cos(0.5), 0.3 + 0.099 * np.sin(0.5), 0.0]])  # just within the long edge's end
    assert came_over(end, with_blocks(dataclasses.replace(BLOCK, yaw=0.5)))
    assert not came_over(end, with_blocks(dataclasses.replace(BLOCK, yaw=-0.5)))


def test_on_a_slope_the_blocks_lie_on_the_slope() -> None:
    pitch = 0.35
    uphill = np.array([[np.cos(pitch) * 1.095, 0.3, -np.sin(pitch) * 1.095]])  # of the plane, 1.095 m along it
    assert came_over(uphill, with_blocks(BLOCK, slope_pitch=pitch))
    assert not came_over(uphill, with_blocks(dataclasses.replace(BLOCK, size=(0.18, 0.1, 0.07)), slope_pitch=pitch))


def test_a_path_that_diverged_is_over_nothing() -> None:
    assert not came_over(np.full((5, 3), np.nan), with_blocks(BLOCK))


TIME = np.linspace(0.0, 10.0, 400)  # of a path that is 2 m long


def test_who_leaves_the_far_end_of_the_last_block_behind_is_past_all_of_them_also_beside_them() -> None:
    blocks = with_blocks(dataclasses.replace(BLOCK, center=(0.5, 0.0, 0.035)), BLOCK)
    assert time_past(TIME, straight(0.3), blocks) == pytest.approx(5.5, abs=0.03)
    assert time_past(TIME, straight(-0.6), blocks) == pytest.approx(5.5, abs=0.03)
    assert np.isnan(time_past(TIME, straight(0.3, to=1.09), blocks))
    turned = with_blocks(dataclasses.replace(BLOCK, yaw=np.pi / 2))
    assert time_past(TIME, straight(0.3), turned) == pytest.approx(5.25, abs=0.03)
    assert np.isnan(time_past(TIME, np.full((400, 3), np.nan), blocks))


def test_past_the_blocks_is_meant_along_the_heading_at_the_start() -> None:
    left = dataclasses.replace(with_blocks(dataclasses.replace(BLOCK, center=(0.0, 1.0, 0.035))), initial_yaw=np.pi / 2)
    path = straight(0.0)[:, [1, 0, 2]]
    assert time_past(TIME, path, left) == pytest.approx(5.25, abs=0.03)
    assert np.isnan(time_past(TIME, straight(0.0), left))


def test_the_feet_go_along_with_the_trunk() -> None:
    attitude = quaternion_from_rpy(np.zeros(1), np.zeros(1), np.array([np.pi / 2]))
    turned = feet(np.array([[1.0, 2.0, 0.1]]), attitude, np.zeros((1, 18)))[0]
    x, y, z = neutral_feet().T
    np.testing.assert_allclose(turned, np.stack([1.0 - y, 2.0 + x, 0.1 + z], axis=-1), atol=1e-12)


def test_standing_on_a_block_is_seen_with_the_feet_and_without_the_trunk() -> None:
    """A block under the front left foot, low enough to be there from the start, and none under the trunk."""
    x, y, _ = neutral_feet()[0]
    near = Block((float(x), float(y), 0.0005), (0.06, 0.06, 0.001))
    scenario = Scenario("forward", 1.0, blocks=(near,))
    elsewhere = dataclasses.replace(scenario, blocks=(dataclasses.replace(near, center=(2.0, 0.0, 0.0005)),))
    below = dataclasses.replace(scenario, blocks=(dataclasses.replace(near, center=(0.0, 0.0, 0.0005)),))
    model = base_model("hexapod")
    out = simulate(
        model, np.tile(model.mean(), (3, 1)), [scenario, elsewhere, below], controller=find_policy("gait:stand"),
        pairing="zip", timestep=0.01, threads=1,
    )  # fmt: skip
    found = over_blocks(out)
    assert (found.feet.tolist(), found.trunk.tolist()) == ([1, 0, 0], [False, False, True])


def test_the_summary_counts_who_went_over_blocks_and_how_far_they_came_without_those_that_diverged() -> None:
    distance = np.array([4.0, 2.0, 1.0, 0.0, np.nan])
    past_s = np.array([12.0, np.nan, 16.0, np.nan, 3.0])
    over = OverBlocks(np.array([True, False, False, False, True]), np.array([3, 2, 0, 0, 7]), past_s)
    said = Evaluation(distance, distance, distance, over).summary()
    assert (said["over_blocks"], said["foot_over_blocks"]) == (2, 2)
    assert said["blocks_under_feet"] == pytest.approx(5 / 4), "of all that did not diverge"
    assert said["distance_over_blocks_m"] == pytest.approx(3.0)
    assert said["distance_not_over_blocks_m"] == pytest.approx(0.5)
    assert said["past_blocks_share"] == pytest.approx(2 / 5), "of all, and who diverged has not passed"
    assert said["past_blocks_s"] == pytest.approx(14.0)
    only_trunk = OverBlocks(np.ones(5, bool), np.zeros(5, int), np.full(5, np.nan))
    said = Evaluation(distance, distance, distance, only_trunk).summary()
    assert (said["over_blocks"], said["foot_over_blocks"]) == (4, 0)
    assert "distance_not_over_blocks_m" not in said  # there are none
    assert said["past_blocks_share"] == 0.0 and "past_blocks_s" not in said


def test_an_evaluation_speaks_of_blocks_only_where_there_are_some() -> None:
    model, stand = base_model("hexapod"), find_policy("gait:stand")
    said = {task: evaluate(stand, model, draw_conditions(model, task, 2, seed=4)) for task in ("balance", "forward")}
    assert not {key for key in said["balance"].summary() if "block" in key}
    assert said["forward"].summary()["over_blocks"] == said["forward"].summary()["past_blocks_share"] == 0
