"""The sim node in lockstep: nothing is lost, nothing depends on wall time, the same seed gives the same bytes."""

import hashlib
import itertools
from collections.abc import Callable
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup import model_loader
from tcbi_bringup.errors import BringupError
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_msgs.msg import Block, FootContacts, RolloutEvent
from tcbi_msgs.srv import LoadModel, ResetEpisode
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore

pytestmark = pytest.mark.graph

SECOND = 1_000_000_000
WINDOW, PERIOD = SECOND // 5, SECOND // 50
STREAMS = {
    names.JOINT_STATES: JointState,
    names.IMU: Imu,
    names.FOOT_CONTACTS: FootContacts,
    names.TRACKER_POSE: PoseStamped,
}


def nanoseconds(stamp: Any) -> int:
    return stamp.sec * SECOND + stamp.nanosec


class Policy:
    """The least that a policy and a recorder are, inside the test: answers each new time, keeps every byte."""

    def __init__(self, peer: Any, act: Callable[[int], list[float]] = lambda k: [0.1 * (k % 3 - 1)] * 18) -> None:
        self.peer, self.act = peer, act
        self.now, self.start, self.enabled = 0, 0, False
        self.raw: dict[str, list[bytes]] = {}
        for topic, kind in {**STREAMS, names.DIAGNOSTICS: DiagnosticArray}.items():
            self.raw[topic] = []
            peer.node.create_subscription(kind, topic, self.raw[topic].append, 1000, raw=True)
        peer.node.create_subscription(Clock, names.CLOCK, self._on_clock, messages.STREAM_QOS)
        self.commands = peer.publisher(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
        self.events = peer.publisher(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
        peer.wait_until(lambda: self.now > 0, "/clock")

    def _on_clock(self, message: Clock) -> None:
        if (now := nanoseconds(message.clock)) != self.now:
            self.now = now
            self.tick()

    def tick(self) -> None:
        if self.enabled:
            target = self.act((self.now - self.start) // WINDOW)
            self.commands.publish(messages.joint_command(messages.to_stamp(self.now), target))

    def event(self, kind: int, stamp_ns: int) -> None:
        event = RolloutEvent(kind=kind)
        event.header.stamp = messages.to_stamp(stamp_ns)
        self.events.publish(event)

    def reset(self, **request: Any) -> ResetEpisode.Response:
        for messages_seen in self.raw.values():
            messages_seen.clear()
        response = self.peer.call(names.RESET_EPISODE, ResetEpisode.Request(**request), ResetEpisode)
        assert response.success, response.message
        self.start = nanoseconds(response.stamp)
        self.peer.wait_until(lambda: self.now == self.start, "the clock's jump to the episode")
        return response

    def rollout(self, **request: Any) -> None:
        """One whole episode, as the collecting action does it."""
        response = self.reset(**request)
        assert response.source == "sim"
        self.event(RolloutEvent.BEGIN, self.start)
        self.enabled = True
        self.tick()
        end = self.start + round(request["duration"] * SECOND)
        self.peer.wait_until(lambda: self.now >= end, "the episode's end")
        self.enabled = False
        self.event(RolloutEvent.END, end)
        samples = round(request["duration"] * 50) + 1
        self.peer.wait_until(lambda: all(len(self.raw[t]) >= samples for t in STREAMS), "every sample")

    def stamps(self, topic: str) -> list[int]:
        return [nanoseconds(deserialize_message(m, STREAMS[topic]).header.stamp) for m in self.raw[topic]]

    def poses(self) -> list[PoseStamped]:
        """Those of this episode; some of the last one may still have been on their way."""
        poses = [deserialize_message(m, PoseStamped) for m in self.raw[names.TRACKER_POSE]]
        return [pose for pose in poses if nanoseconds(pose.header.stamp) >= self.start]

    def digest(self) -> str:
        """Of every byte of the sensor topics, stamps and all."""
        return hashlib.sha256(b"".join(m for topic in STREAMS for m in self.raw[topic])).hexdigest()


def sim(**parameters: Any) -> NodeProcess:
    return NodeProcess("tcbi_sim", "sim_node", parameters={"mode": "lockstep", **parameters})


@pytest.fixture
def store(tmp_path) -> str:
    """A store of the test's own: the built-in models alone."""
    return str(tmp_path / "store")


def test_the_same_seed_gives_the_same_bytes_in_another_process(start_graph, peer, store):
    digests = []
    block = Block()
    block.center.x, block.center.z = 0.3, 0.03
    block.size.x = block.size.y = block.size.z = 0.06
    for _ in range(2):
        graph = start_graph(sim(store=store))
        policy = Policy(peer)
        policy.rollout(task="balance", seed=3, slope_roll=0.2, duration=2.0)
        first = policy.digest()
        policy.rollout(task="forward", seed=4, blocks=[block], duration=1.0)
        digests.append((first, policy.digest()))
        assert set(graph.stop("sim_node").values()) == {0}
        for node_side in (policy.commands, policy.events):
            peer.node.destroy_publisher(node_side)
        for subscription in list(peer.node.subscriptions):
            peer.node.destroy_subscription(subscription)
    assert digests[0] == digests[1]


def test_every_sample_of_an_episode_arrives_with_its_stamp(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    for seed in (1, 2):
        policy.rollout(task="balance", seed=seed, slope_pitch=0.1, duration=4.0)
        wanted = [policy.start + k * PERIOD for k in range(201)]
        for topic in STREAMS:
            assert policy.stamps(topic) == wanted, topic
        assert policy.start % SECOND == 0


def test_the_clock_waits_for_a_slow_policy_and_stops_at_the_end(start_graph, peer, store):
    start_graph(sim(store=store, lockstep_timeout_s=60.0))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=0.4)
    policy.event(RolloutEvent.BEGIN, policy.start)
    repeats = peer.collect(names.CLOCK, Clock, messages.STREAM_QOS)
    peer.wait_until(lambda: len(repeats) >= 3, "the clock to repeat itself while it waits")
    assert {nanoseconds(m.clock) for m in repeats} == {policy.start}
    policy.enabled = True
    policy.tick()
    peer.wait_until(lambda: policy.now == policy.start + 2 * WINDOW, "the episode's end")
    policy.tick()  # a policy that was not yet told to stop
    repeats.clear()
    peer.wait_until(lambda: len(repeats) >= 2, "the clock to stand at the end")
    assert policy.now == policy.start + 2 * WINDOW
    policy.event(RolloutEvent.END, policy.now)


def test_a_listener_that_is_discovered_late_gets_the_sample_of_the_time_that_stands(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=0.4)
    late = peer.collect(names.JOINT_STATES, JointState, messages.STREAM_QOS)
    peer.wait_until(lambda: bool(late), "the sample")
    assert {nanoseconds(m.header.stamp) for m in late} == {policy.start}
    both = policy.raw[names.JOINT_STATES]
    peer.wait_until(lambda: len(both) == 2, "the same sample where it was heard before")
    assert both[0] == both[1]


def test_a_listener_that_is_discovered_in_a_rollout_under_way_has_no_sample_sent_twice(start_graph, peer, store):
    start_graph(sim(store=store, lockstep_timeout_s=60.0))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=4.0)
    policy.event(RolloutEvent.BEGIN, policy.start)
    policy.enabled = True
    policy.tick()
    peer.wait_until(lambda: policy.now > policy.start, "the rollout")
    policy.enabled = False
    repeats = peer.collect(names.CLOCK, Clock, messages.STREAM_QOS)
    peer.wait_until(lambda: len(repeats) >= 3, "the clock to stand")
    late = peer.collect(names.JOINT_STATES, JointState, messages.STREAM_QOS)
    repeats.clear()
    peer.wait_until(lambda: len(repeats) >= 4, "two seconds in which it stands")
    assert not late
    stamps = policy.stamps(names.JOINT_STATES)
    assert len(stamps) == len(set(stamps))


def test_a_policy_that_died_does_not_stop_the_rollout_and_is_reported(start_graph, peer, store):
    start_graph(sim(store=store, lockstep_timeout_s=0.2))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=8.0)
    policy.event(RolloutEvent.BEGIN, policy.start)
    peer.wait_until(lambda: policy.now >= policy.start + 3 * WINDOW, "windows without commands")
    policy.event(RolloutEvent.ABORT, policy.now)
    said = [deserialize_message(m, DiagnosticArray).status[0].message for m in policy.raw[names.DIAGNOSTICS]]
    assert any("no command" in text for text in said)


def test_stamps_go_on_over_resets_and_model_loads(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    stamps: list[int] = []
    for seed in (1, 2, 3):
        policy.reset(task="balance", seed=seed, duration=1.0)
        peer.wait_until(lambda: len(policy.raw[names.JOINT_STATES]) >= 1, "the first sample")
        stamps += policy.stamps(names.JOINT_STATES)
    policy.raw[names.JOINT_STATES].clear()
    loaded = peer.call(names.LOAD_MODEL, LoadModel.Request(model="hexapod-v0"), LoadModel)
    assert loaded.success and loaded.model == "hexapod-v0"
    peer.wait_until(lambda: len(policy.raw[names.JOINT_STATES]) >= 1, "the sample after the load")
    stamps += policy.stamps(names.JOINT_STATES)
    assert all(b > a for a, b in itertools.pairwise(stamps))


def test_a_reset_and_a_load_take_the_model_version_that_they_name(start_graph, peer, store):
    heavy = ModelStore(store).save(base_model("hexapod").with_effect("payload"))
    start_graph(sim(store=store, model="hexapod-v0", noise=False))
    policy = Policy(peer)
    heights = []
    for model in ("hexapod-v0", heavy.version):
        answer = policy.reset(task="balance", seed=1, duration=1.0, model=model)
        assert answer.message.endswith(f"on {model}")
        peer.wait_until(policy.poses, "the first pose")
        heights.append(policy.poses()[0].pose.position.z)
    assert heights[1] < heights[0] - 1e-4, "the servos give way under the payload"
    loaded = peer.call(names.LOAD_MODEL, LoadModel.Request(model="hexapod-v0"), LoadModel)
    assert loaded.success and loaded.model == "hexapod-v0"
    again = policy.reset(task="balance", seed=1, duration=1.0)
    peer.wait_until(policy.poses, "the first pose")
    assert again.message.endswith("on hexapod-v0")
    assert policy.poses()[0].pose.position.z == heights[0]
    assert model_loader.load_model(heavy.version) == [model_loader.Taken("sim node", heavy.version)]
    assert policy.reset(task="balance", seed=1, duration=1.0).message.endswith(f"on {heavy.version}")


def test_a_model_that_no_graph_could_take_is_told(domain, monkeypatch):
    monkeypatch.setattr(model_loader, "FOUND_S", 0.5)
    with pytest.raises(BringupError, match="no node of a graph offers load_model"):
        model_loader.load_model("hexapod-v0")


def test_what_cannot_be_is_refused_in_one_line_and_nothing_moves(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    before = policy.now
    bad = ResetEpisode.Request(task="dance", slope_roll=2.0, joint_position=[9.0] * 18, blocks=[Block()])
    answer = peer.call(names.RESET_EPISODE, bad, ResetEpisode)
    assert not answer.success and "\n" not in answer.message
    assert all(word in answer.message for word in ("dance", "slope_roll", "lf_coxa", "blocks[0]"))
    endless = peer.call(names.RESET_EPISODE, ResetEpisode.Request(duration=1e300), ResetEpisode)
    assert not endless.success and "duration: got 1e+300" in endless.message
    unknown = peer.call(names.LOAD_MODEL, LoadModel.Request(model="hexapod-v99"), LoadModel)
    assert not unknown.success and "hexapod-v99" in unknown.message and unknown.model == "hexapod-v0"
    policy.reset(task="balance", seed=1, duration=1.0)
    policy.event(RolloutEvent.BEGIN, policy.start)
    policy.enabled = True
    policy.tick()
    peer.wait_until(lambda: policy.now > policy.start, "the rollout")
    running = peer.call(names.LOAD_MODEL, LoadModel.Request(model="hexapod-v0"), LoadModel)
    assert not running.success and "rollout" in running.message
    assert before < policy.start


def test_an_emergency_stop_takes_the_torque_off_until_release_and_reset(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=60.0)
    assert peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger).success
    refused = peer.call(names.RESET_EPISODE, ResetEpisode.Request(task="balance"), ResetEpisode)
    assert not refused.success and "release" in refused.message
    policy.enabled = True
    policy.tick()
    peer.wait_until(lambda: policy.now >= policy.start + 10 * WINDOW, "two seconds of refused commands")
    policy.enabled = False

    def heights() -> list[float]:
        return [pose.pose.position.z for pose in policy.poses()]

    peer.wait_until(
        lambda: min(heights()) < heights()[0] - 0.02, "poses of a robot that sinks, some still on their way"
    )
    height = heights()
    said = [deserialize_message(m, DiagnosticArray) for m in policy.raw[names.DIAGNOSTICS]]
    values = {
        v.key: v.value for d in said if nanoseconds(d.header.stamp) == policy.start + SECOND for v in d.status[0].values
    }
    assert values["commands refused"] == "5"
    assert peer.call(names.RELEASE_EMERGENCY_STOP, Trigger.Request(), Trigger).success
    policy.reset(task="balance", seed=1, duration=1.0)
    peer.wait_until(lambda: len(policy.poses()) >= 1, "the robot on its feet")
    assert policy.poses()[0].pose.position.z > min(height) + 0.02


def test_an_emergency_stop_and_a_second_graph_show_while_the_clock_stands(start_graph, peer, store):
    start_graph(sim(store=store))
    policy = Policy(peer)
    policy.reset(task="balance", seed=1, duration=1.0)

    def status() -> dict[str, str]:
        heard = [deserialize_message(m, DiagnosticArray).status[0] for m in policy.raw[names.DIAGNOSTICS][-1:]]
        return {v.key: v.value for s in heard for v in s.values} | {"message": "".join(s.message for s in heard)}

    assert peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger).success
    peer.wait_until(lambda: status().get("torque") == "emergency stop", "the stop")
    policy.commands.publish(messages.joint_command(messages.to_stamp(policy.now + 9 * SECOND), [0.0] * 18))
    peer.wait_until(lambda: status().get("commands refused") == "1", "the refusal of a command of another time")
    peer.publisher(names.JOINT_STATES, JointState, messages.STREAM_QOS, subscribers=1)
    peer.wait_until(lambda: "another node publishes" in status()["message"], "the other graph")
    assert policy.now == policy.start


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"mode": "lockstep", "timestep": 0.003}, "does not divide"),
        ({"mode": "lockstep", "model": "hexapod-v99"}, "hexapod-v99"),
        ({"mode": "realtime", "use_sim_time": True}, "use_sim_time"),
        ({"mode": "lockstep", "task": "dance"}, "dance"),
        ({"mode": "lockstep", "model": "servo_bench-v0"}, "servo_bench"),
    ],
)
def test_a_wrong_set_up_ends_with_status_1_and_one_line(start_graph, store, parameters, said):
    graph = start_graph(NodeProcess("tcbi_sim", "sim_node", parameters={"store": store, **parameters}), wait=False)
    assert graph.wait_for_exit("sim_node", 60.0) == 1
    assert said in graph.tail("sim_node", 1)
