"""A collection where others place the robot, where a service is slow, and where its end is lost on the way."""

import json
import math
import subprocess
import sys
import time

import pytest
from action_msgs.msg import GoalStatus
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from tcbi_contract import messages, names
from tcbi_infer import collect_client
from tcbi_infer.bags.reader import read_measurement
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import ResetEpisode
from tests.recording_cases import Collection, recorder

pytestmark = pytest.mark.graph


class Robot:
    """A robot without a tracker that cannot tilt its ground, and somebody who can."""

    def __init__(self, peer, hands: bool = True) -> None:
        self.peer, self.resets, self.placed = peer, 0, []
        self.joints = peer.node.create_publisher(JointState, names.JOINT_STATES, messages.STREAM_QOS)
        peer.node.create_service(ResetEpisode, names.RESET_EPISODE, self.reset)
        if hands:
            peer.node.create_service(ResetEpisode, names.PLACE_ROBOT, self.place)
        peer.node.create_timer(0.02, self.measure)

    def now(self):
        return self.peer.node.get_clock().now().to_msg()

    def measure(self) -> None:
        self.joints.publish(messages.joint_state(self.now(), [0.1] * 18))

    def reset(self, request, response):
        self.resets += 1
        response.success, response.source = self.resets > 1, "driver"
        response.message, response.stamp = "still connecting", self.now()
        return response

    def place(self, request, response):
        self.placed.append(request.slope_roll)
        response.success, response.stamp = True, self.now()
        return response


def test_a_robot_is_placed_by_others_and_its_distance_entered_by_hand(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False, distance_timeout_s=30.0))
    robot = Robot(peer)
    entered = peer.publisher(names.DISTANCE, Float64, 10)
    goal = {"task": "balance", "number": 1, "policy": "none", "duration_s": 1.0, "slope_roll": [0.25]}
    collection = Collection(peer, **goal)
    peer.wait_until(lambda: bool(collection.told) and collection.told[-1].remaining_s == 0, "the end of the rollout")
    entered.publish(Float64(data=0.42))
    status, result = collection.result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.message == "1 rollout recorded"
    assert robot.resets == 2 and robot.placed == [0.25, 0.25], "hands free the legs of a robot that fails its reset"
    m = read_measurement(result.bags[0])
    assert (m.distance, m.source, m.policy_id, m.scenario.slope_roll) == (0.42, "driver", "", 0.25)
    assert m.scenario.duration == 1.0 and 0.9 < m.time[-1] <= 1.0


def test_ground_that_nobody_sets_is_not_recorded_as_it_was_drawn(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    Robot(peer, hands=False)
    goal = {"task": "forward", "number": 1, "policy": "none", "duration_s": 0.4, "slope_pitch": [0.1]}
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED and "count as level, and there are no blocks" in result.message
    scenario = read_measurement(result.bags[0]).scenario
    assert (scenario.slope_roll, scenario.slope_pitch, scenario.blocks) == (0.0, 0.1, ())


def test_each_distance_that_is_asked_for_goes_to_its_own_rollout(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    Robot(peer)
    command = [sys.executable, "-m", "tcbi_bringup.cli", "collect", "--n", "3", "--policy", "none", "--duration", "0.4"]
    with subprocess.Popen(
        [*command, "--ask-distance", "--json"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as collect:
        assert collect.stdin is not None and collect.stdout is not None
        collect.stdin.write("0.42\n\nhalf\n0.1\n")
        collect.stdin.flush()
        peer.wait_until(lambda: collect.poll() is not None, "the end of the collection")
        bags = json.loads(collect.stdout.read())["bags"]
    assert [read_measurement(bag).distance for bag in bags] == [0.42, pytest.approx(math.nan, nan_ok=True), 0.1]


class SlowPolicy:
    """It is switched on too late the first time, as on a busy machine."""

    def __init__(self, peer, slow: int) -> None:
        self.slow, self.switched_on = slow, 0
        peer.node.create_service(SetBool, names.ENABLE_POLICY, self.enable)

    def enable(self, request, response):
        if request.data:
            self.switched_on += 1
            if self.switched_on <= self.slow:
                time.sleep(0.7)
        response.success = True
        return response


@pytest.mark.parametrize(("slow", "least"), [(1, 2), (9, 3)])
def test_a_rollout_whose_policy_came_too_late_begins_anew_but_not_for_ever(start_graph, peer, tmp_path, slow, least):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    robot, policy = Robot(peer), SlowPolicy(peer, slow)
    events = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    goal = {"task": "balance", "number": 1, "duration_s": 0.6}
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    starts = policy.switched_on
    assert least <= starts <= 3, "a busy machine may be late once more"
    assert robot.resets - 1 == starts
    peer.wait_until(lambda: events[-1].kind == RolloutEvent.END, "the event of the end")
    kinds = [event.kind for event in events]
    assert kinds == [RolloutEvent.BEGIN, RolloutEvent.ABORT] * (starts - 1) + [RolloutEvent.BEGIN, RolloutEvent.END]
    assert "after the rollout had begun" in events[1].note
    assert ("after the rollout had begun" in events[-1].note) == (slow > 3) == ("too late" in result.message)
    assert [path.name for path in (tmp_path / "bags").iterdir() if path.is_dir()] == [events[-1].rollout_id]


class SlowRobot(Robot):
    """Its first answer comes too late, as one comes never whose asker the middleware had not discovered."""

    def reset(self, request, response):
        if self.resets == 0:
            time.sleep(1.2)
        self.resets += 1
        response.success, response.source, response.stamp = self.resets == 2, "sim", self.now()
        response.message = "the answer to the first request"
        return response


def test_a_service_that_does_not_answer_is_asked_once_more_and_its_last_answer_counts(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False, service_timeout_s=2.0))
    robot = SlowRobot(peer)
    goal = {"task": "balance", "number": 1, "policy": "none", "duration_s": 0.5}
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert robot.resets == 2


def test_the_end_of_a_collection_is_asked_for_again_where_the_first_question_is_lost(domain, monkeypatch):
    class Goal:
        def __init__(self) -> None:
            self.asked: list[Future] = []

        def get_result_async(self) -> Future:
            self.asked.append(Future())
            if len(self.asked) == 2:
                self.asked[-1].set_result("the end")
            return self.asked[-1]

    monkeypatch.setattr(collect_client, "ASK_AGAIN_S", 0.3)
    goal = Goal()
    with collect_client.CollectClient(domain) as client:
        assert client._end(goal).result() == "the end"
    assert len(goal.asked) == 2
