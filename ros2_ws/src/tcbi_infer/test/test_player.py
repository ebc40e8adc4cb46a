"""A bag as a schedule: every message once, in the order of its time, under the contract's name."""

import pytest
from bag_cases import rollout

from tcbi_contract.names import IMU, JOINT_STATES, ROLLOUT_EVENT
from tcbi_infer.bags.measurement_writer import START_NS, write_measurement
from tcbi_infer.bags.scan import Scan
from tcbi_infer.errors import BagError
from tcbi_infer.player import schedule


def test_every_message_is_played_once_in_the_order_of_time(tmp_path):
    bag = write_measurement(tmp_path, rollout(), namespace="/robot")
    plan = schedule(bag)
    recorded = list(Scan(bag / "walk_1_0.mcap").messages())
    assert sorted(cue.data for cue in plan.cues) == sorted(m.data for m in recorded)
    times = [cue.time for cue in plan.cues]
    assert times == sorted(times)
    assert (plan.start, plan.end) == (START_NS, START_NS + 2_000_000_000)
    assert plan.topics[0] == JOINT_STATES and plan.others == () and plan.cues[0].topic == ROLLOUT_EVENT


def test_only_the_wanted_topics_are_played(tmp_path):
    bag = write_measurement(tmp_path, rollout())
    assert schedule(bag, (IMU,)).topics == (IMU,)
    with pytest.raises(BagError, match="topics: got imu, allowed are"):
        schedule(bag, ("imu",))


def test_a_cut_off_bag_plays_as_far_as_it_goes_and_says_so(tmp_path):
    file = write_measurement(tmp_path, rollout(samples=400)) / "walk_1_0.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    plan = schedule(file)
    assert 300 < len(plan.cues) < 1200 and "is damaged" in plan.notes[0]
