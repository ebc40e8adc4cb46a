"""What a goal of `collect_rollouts` means: the same scenarios for the same seed, and all its faults at once."""

import dataclasses
import math

import pytest

from tcbi_infer.collection import Request, check, rollout_id, scenario_of, travelled
from tcbi_infer.errors import RecordingError


def test_the_same_seed_gives_the_same_scenarios_whatever_else_is_asked():
    short, long = Request("balance", 2, seed=3), Request("balance", 50, seed=3, policy="gait:tripod")
    assert [scenario_of(short, i) for i in range(2)] == [scenario_of(long, i) for i in range(2)]
    drawn = {scenario_of(long, i).slope_roll for i in range(50)}
    assert len(drawn) == 50
    assert scenario_of(dataclasses.replace(short, seed=4), 0) != scenario_of(short, 0)


def test_given_slopes_and_durations_replace_the_drawn_ones():
    request = Request("balance", 2, slope_roll=(0.1, 0.2), slope_pitch=(0.0, -0.1), duration_s=3.0)
    second = scenario_of(request, 1)
    assert (second.slope_roll, second.slope_pitch, second.duration) == (0.2, -0.1, 3.0)
    assert second.initial_joint_position == scenario_of(Request("balance", 2), 1).initial_joint_position


def test_the_blocks_of_forward_are_drawn():
    assert scenario_of(Request("forward", 1, seed=1), 0).blocks


def test_all_faults_of_a_goal_come_in_one_line():
    with pytest.raises(RecordingError) as error:
        check(Request("dance", 0, slope_roll=(0.1, 9.0), duration_s=-1.0))
    text = str(error.value)
    assert all(
        word in text for word in ("task: got 'dance'", "number: got 0", "duration_s: got -1.0", "slope_roll: got 2")
    )
    assert "\n" not in text


def test_a_slope_beyond_the_contract_is_refused():
    with pytest.raises(RecordingError, match=r"slope_pitch: got 0\.6, allowed is -pi/6 to pi/6"):
        check(Request("balance", 1, slope_pitch=(0.6,)))


def test_ids_differ_and_sort_by_time():
    request = Request("balance", 2, seed=1)
    ids = [rollout_id(request, 0, 0.0), rollout_id(request, 1, 0.0), rollout_id(request, 0, 1.0)]
    assert ids == sorted(set(ids)) and ids[0] == "balance-19700101-000000-000-s1-000"


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_distance_is_measured_along_the_heading_at_the_start(yaw):
    end = (1 + 2 * math.cos(yaw) - 0.5 * math.sin(yaw), 1 + 2 * math.sin(yaw) + 0.5 * math.cos(yaw), 0.3)
    assert travelled((1, 1, 0), end, (0, 0, math.sin(yaw / 2), math.cos(yaw / 2))) == pytest.approx(2.0)


def test_a_tracker_without_orientation_measures_along_the_worlds_x():
    assert travelled((0, 0, 0), (1.5, 1.0, 0), (math.nan,) * 4) == 1.5
