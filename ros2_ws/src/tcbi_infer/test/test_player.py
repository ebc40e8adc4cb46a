"""A bag as a schedule: every message once, in the order of its time, under the contract's name."""

import pytest
from bag_cases import rollout

from tcbi_contract.names import IMU, JOINT_STATES, ROLLOUT_EVENT
from tcbi_infer.bags.encoding import messages
from tcbi_infer.bags.measurement_writer import START_NS, write_measurement
from tcbi_infer.bags.scan import Scan
from tcbi_infer.bags.writer import BagWriter
from tcbi_infer.errors import BagError
from tcbi_infer.player import schedule
from tcbi_sim.errors import UnknownNameError


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
    with pytest.raises(UnknownNameError, match=r"unknown topic 'imu'; .*known: joint_states, imu/data"):
        schedule(bag, ("imu",))


def test_a_bag_without_what_is_wanted_says_what_it_has_and_what_to_do(tmp_path):
    with BagWriter(tmp_path, "lab") as bag:
        bag.append(bag.add_topic("/wheels", "std_msgs/msg/Float64"), START_NS, bytes(12))
    with pytest.raises(BagError, match=r"of the contract's topics; it has /wheels; play it with `ros2 bag play`"):
        schedule(bag.path)
    with BagWriter(tmp_path, "events") as bag:
        topic, time, data = next(iter(messages(rollout(), START_NS)))
        bag.write(f"/{topic}", time, data)
    with pytest.raises(BagError, match=f"holds no message of {IMU}; choose from {ROLLOUT_EVENT}"):
        schedule(bag.path, (IMU,))


def test_a_cut_off_bag_plays_as_far_as_it_goes_and_says_so(tmp_path):
    file = write_measurement(tmp_path, rollout(samples=400)) / "walk_1_0.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    plan = schedule(file)
    assert 300 < len(plan.cues) < 1200 and "is damaged" in plan.notes[0]


@pytest.mark.parametrize("back_s", [1.0, 3600.0])
@pytest.mark.parametrize(("before", "after"), [(150, 60), (60, 150)])
def test_where_the_clock_was_set_back_the_longest_stretch_is_played(tmp_path, before, after, back_s):
    first = list(messages(rollout(samples=before), 4_000 * START_NS))
    then = list(messages(rollout(samples=after), first[-1][1] - round(back_s * 1e9)))
    longest = first if before > after else then
    stray = next(row for row in then if row[0] == IMU)  # overtook the last before the clock was set
    rows = [*first[:-8], stray, *first[-8:], *(row for row in then if row is not stray)]
    with BagWriter(tmp_path, "walk_1") as bag:
        for topic, time, data in rows:
            bag.write(f"/{topic}", time, data)
    plan = schedule(bag.path)
    played = [(cue.topic, cue.data) for cue in plan.cues]
    expected = [(topic, data) for topic, _, data in longest]
    assert (plan.start, plan.end) == (longest[0][1], longest[-1][1])
    assert abs(len(played) - len(expected)) <= 1 and len(set(played) ^ set(expected)) <= 1, "but for the stray one"
    (note,) = plan.notes
    assert "time goes back once" in note and "only the longest stretch is used, 150 of 210 samples" in note
