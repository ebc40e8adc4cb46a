"""A reset request becomes a scenario, or one line with everything that is wrong."""

import math
from types import SimpleNamespace

import pytest

from tcbi_contract.names import JOINTS
from tcbi_sim.episode import EpisodeError, first_scenario, requested_scenario
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.measurement import Block


def request(**changes: object) -> SimpleNamespace:
    values = dict(task="balance", slope_roll=0.1, slope_pitch=-0.2, blocks=[], yaw=0.0, joint_position=[], seed=7)
    values["duration"] = 0.0
    return SimpleNamespace(**{**values, **changes})


def block(x: float = 0.5, edge: float = 0.06, yaw: float = 0.0) -> SimpleNamespace:
    size = SimpleNamespace(x=edge, y=edge, z=edge)
    return SimpleNamespace(center=SimpleNamespace(x=x, y=0.0, z=edge / 2), size=size, yaw=yaw)


def test_what_is_asked_for_is_what_stands_there():
    scenario = requested_scenario(request(blocks=[block()], joint_position=[0.1] * len(JOINTS), duration=3.0, yaw=-2.0))
    assert (scenario.slope_roll, scenario.slope_pitch, scenario.seed, scenario.duration) == (0.1, -0.2, 7, 3.0)
    assert scenario.blocks == (Block((0.5, 0.0, 0.03), (0.06, 0.06, 0.06)),)
    assert scenario.initial_joint_position == (0.1,) * len(JOINTS) and scenario.initial_yaw == -2.0


def test_what_is_left_out_is_the_tasks_own_or_neutral():
    assert requested_scenario(request(task="forward")).duration == 30.0
    assert requested_scenario(request()).initial_joint_position is None
    assert requested_scenario(request(task="")).duration == math.inf


def test_every_fault_is_named_at_once():
    wrong = request(
        task="dance",
        slope_roll=1.0,
        slope_pitch=math.nan,
        joint_position=[0.0] * 17 + [0.6],
        blocks=[block(), block(x=math.inf), block(edge=0.0)],
        duration=-1.0,
        yaw=math.nan,
    )
    with pytest.raises(EpisodeError) as error:
        requested_scenario(wrong)
    text = str(error.value)
    for word in ("dance", "slope_roll", "slope_pitch", "rr_tibia=0.6", "blocks[1]", "blocks[2].size", "duration"):
        assert word in text
    assert "yaw: got nan" in text
    assert "\n" not in text


@pytest.mark.parametrize("count", [1, 17, 19])
def test_a_posture_of_another_robot_is_refused(count):
    with pytest.raises(EpisodeError, match=f"got {count} values"):
        requested_scenario(request(joint_position=[0.0] * count))


def test_the_first_scenario_is_drawn_by_its_seed():
    assert first_scenario("balance", 3) == first_scenario("balance", 3) != first_scenario("balance", 4)
    assert first_scenario("", 3).blocks == ()
    with pytest.raises(UnknownNameError, match="balance"):
        first_scenario("balnce", 3)
