"""A collection where others place the robot, and where a service is slow."""

import json
import math
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from action_msgs.msg import GoalStatus
from rclpy.clock import Clock
from rclpy.logging import get_logger
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.arguments import Parser
from tcbi_bringup.commands import collect
from tcbi_contract import messages, names
from tcbi_infer import collector_services
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.collection import Request, scenario_of
from tcbi_msgs.action import CollectRollouts
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
            self.offer_hands()
        peer.node.create_timer(0.02, self.measure)

    def offer_hands(self) -> None:
        self.peer.node.create_service(ResetEpisode, names.PLACE_ROBOT, self.place)

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
    peer.wait_until(lambda: bool(collection.told), "the rollout")
    entered.publish(Float64(data=7.0))  # too late for a rollout before this one
    peer.wait_until(lambda: collection.told[-1].remaining_s == 0, "the end of the rollout")
    entered.publish(Float64(data=0.42))
    status, result = collection.result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.message == "1 rollout recorded"
    assert robot.resets == 2 and robot.placed == [0.25, 0.25], "hands free the legs of a robot that fails its reset"
    m = read_measurement(result.bags[0])
    assert (m.distance, m.source, m.policy_id, m.scenario.slope_roll) == (0.42, "driver", "", 0.25)
    assert m.scenario.duration == 1.0 and 0.9 < m.time[-1] <= 1.0


def test_ground_that_nobody_sets_is_not_recorded_as_it_was_drawn_until_hands_come(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    robot = Robot(peer, hands=False)
    goal = {"task": "forward", "number": 1, "policy": "none", "duration_s": 0.4, "slope_pitch": [0.1]}
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED and "count as level, and there are no blocks" in result.message
    scenario = read_measurement(result.bags[0]).scenario
    assert (scenario.slope_roll, scenario.slope_pitch, scenario.blocks) == (0.0, 0.1, ())
    before = robot.resets
    collection = Collection(peer, **goal)
    peer.wait_until(lambda: robot.resets > before, "the next collection's reset")
    peer.comes(lambda: False, 0.3)
    robot.offer_hands()
    status, result = collection.result()
    assert status == GoalStatus.STATUS_SUCCEEDED and result.message == "1 rollout recorded"
    assert len(robot.placed) == 1, "a later collection waits for hands again"


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


@pytest.mark.parametrize(("prompt", "placed", "kept"), [("place the robot", 0, 0), ("distance in m", 2, 1)])
def test_ctrl_c_at_a_prompt_frees_the_recorder_and_keeps_a_rollout_that_is_over(
    start_graph, peer, tmp_path, prompt, placed, kept
):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    Robot(peer, hands=False)
    events = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    command = [sys.executable, "-m", "tcbi_bringup.cli", "collect", "--n", "2", "--policy", "none", "--duration", "0.4"]
    said = tmp_path / "said"
    with (
        said.open("w") as stderr,
        subprocess.Popen(
            [*command, "--place", "--ask-distance"], stdin=subprocess.PIPE, stdout=stderr, stderr=stderr, text=True
        ) as asking,
    ):
        assert asking.stdin is not None
        asking.stdin.write("\n" * placed)
        asking.stdin.flush()
        peer.wait_until(lambda: prompt in said.read_text(), "the prompt")
        asking.send_signal(signal.SIGINT)
        peer.wait_until(lambda: asking.poll() is not None, "the end of the command")
    assert asking.returncode == 1
    assert f"{kept} of 2 rollouts recorded: cancelled" in said.read_text()
    assert len([path for path in (tmp_path / "bags").iterdir() if path.is_dir()]) == kept
    if kept:
        peer.wait_until(lambda: len(events) == 2, "BEGIN and one more")
        assert events[1].kind == RolloutEvent.END and math.isnan(events[1].distance)


def test_nobody_at_the_prompt_starts_no_robot_and_frees_the_recorder(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    robot = Robot(peer, hands=False)
    command = [sys.executable, "-m", "tcbi_bringup.cli", "collect", "--policy", "none", "--duration", "0.4", "--place"]
    for _ in range(2):
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as asking:
            peer.wait_until(lambda asking=asking: asking.poll() is not None, "the end of the command")
            assert asking.stderr is not None
            assert "tcbi: standard input has ended, so nobody can answer" in asking.stderr.read()
        assert asking.returncode == 1
    assert robot.resets and not [path for path in (tmp_path / "bags").iterdir() if path.is_dir()]


def test_two_robots_are_not_recorded_as_one(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False, alone_timeout_s=2.0))
    robot = Robot(peer)
    second = peer.node.create_publisher(JointState, names.JOINT_STATES, messages.STREAM_QOS)
    goal = {"task": "balance", "number": 1, "policy": "none", "duration_s": 0.4}
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_ABORTED and robot.resets == 0
    assert result.message.startswith("2 nodes publish joint_states, allowed is one")
    peer.node.destroy_publisher(second)
    status, result = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message


class Service:
    """A service as its client sees it."""

    def __init__(self, answer) -> None:
        self.call_async = answer

    def service_is_ready(self) -> bool:
        return True


class Placing:
    """A driver that stamps its resets by their number, and hands that take their time; without a graph."""

    def __init__(self, placing_s: float) -> None:
        self.placing_s, self.asked = placing_s, []
        services = {names.RESET_EPISODE: Service(self.reset), names.PLACE_ROBOT: Service(self.place)}
        self.services = collector_services.Services(
            SimpleNamespace(
                create_client=lambda _, name: services.get(name),
                values=SimpleNamespace(service_timeout_s=5.0, place_timeout_s=5.0),
                get_clock=Clock,
                get_logger=lambda: get_logger("placing"),
            )
        )

    def reset(self, _) -> Future:
        self.asked.append(names.RESET_EPISODE)
        response = ResetEpisode.Response(success=True, source="driver")
        response.stamp.sec = len(self.asked)
        future = Future()
        future.set_result(response)
        return future

    def place(self, _) -> SimpleNamespace:
        self.asked.append(names.PLACE_ROBOT)
        placed = time.monotonic() + self.placing_s
        response = ResetEpisode.Response(success=True)
        response.stamp.sec = len(self.asked)
        return SimpleNamespace(done=lambda: time.monotonic() > placed, result=lambda: response)

    def run(self, goal):
        """What a reset with its placing answers to a goal."""
        coroutine = self.services.reset_episode(goal, scenario_of(Request("balance", 1), 0), "")
        while True:
            try:
                coroutine.send(None)
            except StopIteration as end:
                return end.value


@pytest.mark.parametrize(("held_s", "resets"), [(5.0, 1), (0.05, 2)])
def test_a_robot_that_may_have_gone_limp_while_it_was_placed_is_reset_again(monkeypatch, held_s, resets):
    monkeypatch.setattr(collector_services, "HELD_S", held_s)
    placing = Placing(0.1)
    reset, placed = placing.run(SimpleNamespace(is_cancel_requested=False))
    assert placing.asked == [names.RESET_EPISODE, names.PLACE_ROBOT, names.RESET_EPISODE][: resets + 1]
    assert placed and reset.stamp.sec == len(placing.asked), "the last answer's stamp is the rollout's zero"


def test_hands_are_waited_for_until_the_goal_is_cancelled():
    placing = Placing(math.inf)
    with pytest.raises(collector_services.CancelledError):
        placing.run(SimpleNamespace(is_cancel_requested=True))
    assert placing.asked == [names.RESET_EPISODE, names.PLACE_ROBOT]


@pytest.mark.parametrize("more", ["", "; in 1 the policy came too late for its first tick"])
def test_what_the_recorder_says_beside_the_number_is_shown(monkeypatch, capsys, more):
    result = CollectRollouts.Result(success=True, message=f"2 rollouts recorded{more}", bags=["one", "two"])
    monkeypatch.setattr(collect, "_ask", lambda *_: (result, True))
    parser = Parser()
    collect.add_arguments(parser)
    assert collect.run(parser.parse_args(["--n", "2"])) == 0
    out, err = capsys.readouterr()
    assert out == "one\ntwo\n"
    assert (result.message in err) == bool(more)


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


class MutePolicy(SlowPolicy):
    """It stops at once when it is switched on, as where its sensors are silent for a moment; later it acts."""

    def __init__(self, peer, mute: int) -> None:
        super().__init__(peer, 0)
        self.peer, self.mute = peer, mute
        self.commands = peer.node.create_publisher(JointTrajectory, names.JOINT_COMMANDS, messages.STREAM_QOS)
        peer.node.create_timer(0.1, self.act)

    def act(self) -> None:
        if self.switched_on > self.mute:
            self.commands.publish(messages.joint_command(self.peer.node.get_clock().now().to_msg(), [0.0] * 18))


@pytest.mark.parametrize("mute", [1, 9])
def test_a_rollout_in_which_the_policy_never_acts_begins_anew_but_not_for_ever(start_graph, peer, tmp_path, mute):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    robot, policy = Robot(peer), MutePolicy(peer, mute)
    status, result = Collection(peer, task="balance", number=1, duration_s=2.0).result()
    assert (status == GoalStatus.STATUS_SUCCEEDED) == (mute == 1), result.message
    assert policy.switched_on == robot.resets - 1
    assert min(mute + 1, 3) <= policy.switched_on <= 3, "a busy machine may be late once more"
    assert ("has sent no joint_commands" in result.message) == (mute > 1)
    assert sum(path.is_dir() for path in (tmp_path / "bags").iterdir()) == 1, "only the last start is kept"


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
