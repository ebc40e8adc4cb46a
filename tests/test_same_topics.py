"""Driver and simulation publish the same, field by field; with the same physics behind them, the same numbers."""

import contextlib
import itertools
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hexapod_driver.driver_node import DriverNode
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_msgs.msg import FootContacts
from tcbi_msgs.srv import ResetEpisode
from tcbi_sim.measurement import roll_pitch_yaw
from tcbi_sim.rigs import load_rig
from tcbi_sim.sim_node import SimNode
from tests.conftest import ros_in_process

pytestmark = pytest.mark.graph

OF_EVERY_NODE = ("parameter_events", "rosout")
STREAMS = {names.JOINT_STATES: JointState, names.IMU: Imu, names.FOOT_CONTACTS: FootContacts}
NODES = ("sim_node", "driver_node")
BODY = Path(__file__).with_name("simulated_body.py")
STANDING = 22  # commands of `motion` while all feet stand; one that lands knocks, briefly, and never twice alike
LAG_S = 0.04  # of the driver behind the sim node: the wire, and up to one cycle each of servos and of readings
UNEQUAL = 0.03  # share of contacts: a foot that lifts or lands may do so one sample earlier or later


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    """A serial port with the sim node's physics behind it."""
    with simulated_body(tmp_path / "robot") as link:
        yield link


@contextlib.contextmanager
def simulated_body(link: Path) -> Iterator[str]:
    """A robot at a new serial port, held by hand until its servos are first switched on."""
    with subprocess.Popen([sys.executable, str(BODY), str(link)], stdout=subprocess.PIPE, text=True) as body:
        assert body.stdout is not None
        yield body.stdout.readline().strip()
        body.terminate()
    assert body.returncode == 0


def process(node: str, port: str, store: Path) -> NodeProcess:
    if node == "sim_node":
        return NodeProcess("tcbi_sim", node, parameters={"store": str(store)})
    return NodeProcess("hexapod_driver", node, parameters={"port": port})


def stamp(message: Any) -> float:
    return messages.seconds(message.header.stamp)


class Listener:
    """Everything that a node publishes, with the time of arrival, and a hand on its commands."""

    def __init__(self, peer: Any) -> None:
        self.peer = peer
        self.seen: dict[str, list[Any]] = {topic: [] for topic in (*STREAMS, names.DIAGNOSTICS)}
        self.arrived: dict[str, list[float]] = {topic: [] for topic in self.seen}
        for topic, kind in {**STREAMS, names.DIAGNOSTICS: DiagnosticArray}.items():
            peer.node.create_subscription(kind, topic, lambda m, t=topic: self._take(t, m), messages.STREAM_QOS)
        self.commands = peer.publisher(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
        peer.wait_until(lambda: all(self.seen.values()), "every topic")

    def _take(self, topic: str, message: Any) -> None:
        self.seen[topic].append(message)
        self.arrived[topic].append(time.time())

    def clear(self) -> None:
        for topic in self.seen:
            self.seen[topic].clear()
            self.arrived[topic].clear()

    def reset(self) -> None:
        assert messages.seconds(self.peer.reset().stamp) > 0

    def play(self, targets: np.ndarray) -> np.ndarray:
        """Send (K, 18) targets at 5 Hz on the ROS clock; returns their stamps (s)."""
        clock = self.peer.node.get_clock()
        start, sent = clock.now().nanoseconds, []
        for k, target in enumerate(targets):
            due = start + k * 200_000_000
            self.peer.wait_until(lambda due=due: clock.now().nanoseconds >= due, "the next tick")
            now = clock.now()
            self.commands.publish(messages.joint_command(now.to_msg(), target))
            sent.append(now.nanoseconds * 1e-9)
        return np.array(sent)


def shape(message: Any) -> dict[str, Any]:
    """What must be equal in any two messages of a topic: frames, names, lengths, covariances, what is left empty."""
    if isinstance(message, JointState):
        lengths = [len(message.position), len(message.velocity), len(message.effort)]
        return {"frame": message.header.frame_id, "name": list(message.name), "lengths": lengths}
    if isinstance(message, Imu):
        parts = ("orientation", "angular_velocity", "linear_acceleration")
        return {"frame": message.header.frame_id} | {p: list(getattr(message, f"{p}_covariance")) for p in parts}
    lengths = [len(message.contact), len(message.force)]
    return {"frame": message.header.frame_id, "name": list(message.name), "lengths": lengths}


def endpoints(peer: Any, topic: str) -> list[tuple[str, ReliabilityPolicy, DurabilityPolicy]]:
    found = peer.node.get_publishers_info_by_topic(topic)
    return [(e.topic_type, e.qos_profile.reliability, e.qos_profile.durability) for e in found]


def test_every_field_of_every_topic_is_alike(start_graph, peer, port, tmp_path):
    shapes, offered, services, published = {}, {}, {}, {}
    for node in NODES:
        graph = start_graph(process(node, port, tmp_path / "store"))
        listener = Listener(peer)
        listener.reset()
        listener.clear()
        peer.wait_until(lambda seen=listener.seen: all(len(seen[t]) >= 120 for t in STREAMS), "120 samples of each")
        for topic in STREAMS:
            check_stream(listener, topic)
        check_values(listener)
        check_diagnostics(listener)
        shapes[node] = {topic: shape(seen[-1]) for topic, seen in listener.seen.items() if topic in STREAMS}
        for topic in STREAMS:
            assert all(shape(m) == shapes[node][topic] for m in listener.seen[topic]), topic
        offered[node] = {topic: endpoints(peer, topic) for topic in listener.seen}
        here = dict(peer.node.get_service_names_and_types_by_node(node, "/"))
        wanted = (names.RESET_EPISODE, names.EMERGENCY_STOP, names.RELEASE_EMERGENCY_STOP)
        services[node] = {service: here[f"/{service}"] for service in wanted}
        published[node] = {t.lstrip("/") for t, _ in peer.node.get_publisher_names_and_types_by_node(node, "/")}
        graph.stop(node)
        for subscription in list(peer.node.subscriptions):
            peer.node.destroy_subscription(subscription)
    assert shapes["sim_node"] == shapes["driver_node"]
    assert offered["sim_node"] == offered["driver_node"]
    assert services["sim_node"] == services["driver_node"]
    assert published["driver_node"] == {*STREAMS, names.DIAGNOSTICS, *OF_EVERY_NODE}
    assert published["sim_node"] == published["driver_node"] | {names.TRACKER_POSE}, "nothing else of its truth"
    reliable = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
    for topic, kind in (*STREAMS.items(), (names.DIAGNOSTICS, DiagnosticArray)):
        package, module = kind.__module__.split(".")[0], kind.__name__
        assert offered["sim_node"][topic] == [(f"{package}/msg/{module}", *reliable)]


def test_both_keep_as_many_messages_as_the_contract_says(domain, port, tmp_path):
    """Asked of the nodes themselves: the middleware tells other nodes neither history nor depth."""

    def kept_by(make: type[Node]) -> dict[str, tuple]:
        node = make()
        kept = {p.topic.lstrip("/"): (p.qos_profile.history, p.qos_profile.depth) for p in node.publishers}
        node.destroy_node()
        return kept

    for name, make in (("sim_node", SimNode), ("driver_node", DriverNode)):
        with ros_in_process(process(name, port, tmp_path / "store").ros_arguments()):
            kept = kept_by(make)
        expected = dict.fromkeys((*STREAMS, names.DIAGNOSTICS), (HistoryPolicy.KEEP_LAST, 50))
        assert {topic: kept.get(topic) for topic in expected} == expected, name


def check_stream(listener: Listener, topic: str) -> None:
    """Stamps increase strictly, at 50 Hz, and say when it was measured: before it arrived, and not long before."""
    stamps = np.array([stamp(m) for m in listener.seen[topic]])
    assert all(b > a for a, b in itertools.pairwise(stamps)), topic
    assert 0.018 < np.median(np.diff(stamps)) < 0.022, topic
    age = np.array(listener.arrived[topic]) - stamps
    assert age.min() > -0.025, topic  # the sim's grid may run ahead of its delivery by less than a sample
    assert np.median(age) < 0.1, topic


def check_values(listener: Listener) -> None:
    """Units: a robot that stands level has gravity on z, no rate, joints near zero, feet on the ground."""
    imu, joints = listener.seen[names.IMU], listener.seen[names.JOINT_STATES]
    force = np.mean([[v.x, v.y, v.z] for v in (m.linear_acceleration for m in imu)], axis=0)
    np.testing.assert_allclose(force, [0, 0, 9.81], atol=0.15)
    rate = np.mean([[v.x, v.y, v.z] for v in (m.angular_velocity for m in imu)], axis=0)
    np.testing.assert_allclose(rate, 0, atol=0.02)
    turn = np.array([[o.x, o.y, o.z, o.w] for o in (m.orientation for m in imu)])
    np.testing.assert_allclose(np.linalg.norm(turn, axis=1), 1, atol=1e-3)
    assert np.abs(turn[:, 3]).min() > 0.99
    assert np.abs([m.position for m in joints]).max() < 0.2
    assert np.mean([m.contact for m in listener.seen[names.FOOT_CONTACTS]]) > 0.8
    assert tuple(joints[-1].name) == names.JOINTS
    assert tuple(listener.seen[names.FOOT_CONTACTS][-1].name) == names.LEGS


def check_diagnostics(listener: Listener) -> None:
    stamps = [stamp(m) for m in listener.seen[names.DIAGNOSTICS]]
    assert len(stamps) >= 2
    assert 0.8 < np.median(np.diff(stamps)) < 1.25
    assert all(status.name and status.message for m in listener.seen[names.DIAGNOSTICS] for status in m.status)


def motion() -> np.ndarray:
    """(K, 18) targets: each kind of joint in turn, out, held, and back, gently; then three feet lifted, and a bow."""
    legs, kinds = np.array([name.split("_") for name in names.JOINTS]).T
    poses = [np.zeros(len(names.JOINTS))]
    for kind, angle in (("femur", 0.15), ("tibia", -0.12), ("coxa", 0.1)):
        poses += [np.where(kinds == kind, angle * share, 0.0) for share in (0.5, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0)]
    assert len(poses) == STANDING
    for raised, angle in ((("lf", "rm", "lr"), 0.3), (("rf", "lm", "rr"), 0.3), (("lf", "rf"), 0.25)):
        moved = np.isin(legs, raised) & (kinds == "femur")
        poses += [np.where(moved, angle * share, 0.0) for share in (0.25, 0.5, 0.75, 1.0, 1.0, 0.75, 0.5, 0.25, 0.0)]
    return np.array(poses)


def test_the_same_commands_to_the_same_physics_give_the_same_recording(start_graph, peer, tmp_path):
    noise = load_rig("hexapod").noise
    sds = {
        "joints": np.hypot(noise.joint_position, noise.encoder_step / np.sqrt(12)),
        "rates": noise.angular_velocity,
        "forces": noise.linear_acceleration,
        "tilt": noise.attitude,
    }
    limits = {signal: 2.0 * np.sqrt(2) * sd for signal, sd in sds.items()} | {"contacts": UNEQUAL, "lag": LAG_S}
    for attempt in range(4):  # a busy machine delays commands, which only ever adds to the differences
        with simulated_body(tmp_path / f"robot{attempt}") as port:
            differences, moved = recorded_twice(start_graph, peer, port, tmp_path / "store", tuple(sds))
        assert np.ptp(moved["joints"], axis=0).min() > 0.05, "every joint moved, so that agreement means something"
        assert np.ptp(moved["tilt"], axis=0).min() > 0.035, "the trunk rolled and pitched"
        assert np.ptp(moved["contacts"], axis=0).min() == 1, "every foot was on the ground and off it"
        apart = {signal: d for signal, d in differences.items() if not d < limits[signal]}
        if not apart:
            return
    pytest.fail(f"differences {apart} beyond what the sensors' noise allows: {limits}")


def recorded_twice(start_graph, peer, port, store: Path, signals: tuple[str, ...]) -> tuple[dict[str, float], Any]:
    """Root mean square difference of each signal between driver and sim node, the share of contacts that differ, the
    lag of one behind the other (s), and what the sim node has recorded."""
    recordings, sent, targets = {}, {}, motion()
    for node in NODES:
        graph = start_graph(process(node, port, store))
        listener = Listener(peer)
        for _ in range(4):
            jumps = clock_jumps(listener)
            listener.reset()
            listener.clear()
            sent[node] = listener.play(targets)
            last = sent[node][-1] + 0.3
            peer.wait_until(lambda seen=listener.seen, last=last: stamp(seen[names.IMU][-1]) > last, "the last samples")
            peer.wait_until(lambda seen=listener.seen: len(seen[names.DIAGNOSTICS]) >= 2, "diagnostics")
            if clock_jumps(listener) == jumps:  # else this machine was too busy for real time
                break
        recordings[node] = series(listener)
        graph.stop(node)
        for subscription in list(peer.node.subscriptions):
            peer.node.destroy_subscription(subscription)
    # compared at the same times since each command, for no two runs send them at quite the same times
    grid = {node: (sent[node][:-1, None] + np.arange(0.02, 0.2, 0.02)).ravel() for node in NODES}

    def difference(signal: str, lag: float) -> np.ndarray:
        driver = at(recordings["driver_node"], signal, grid["driver_node"] + lag)
        return driver - at(recordings["sim_node"], signal, grid["sim_node"])

    lag = min(np.arange(-0.15, 0.15, 0.001), key=lambda x: rms(difference("joints", x)))
    moved = {signal: at(recordings["sim_node"], signal, grid["sim_node"]) for signal in ("joints", "tilt", "contacts")}
    standing = {"forces": STANDING * len(grid["sim_node"]) // len(targets[:-1])}
    differences = {signal: rms(difference(signal, lag)[: standing.get(signal)]) for signal in signals}
    unequal = np.abs(difference("contacts", lag)) > 0.5
    return differences | {"contacts": float(unequal.mean()), "lag": abs(float(lag))}, moved


def clock_jumps(listener: Listener) -> str:
    """How often the sim node has lost its real time, as it says itself; nothing of the driver's."""
    said = {v.key: v.value for status in listener.seen[names.DIAGNOSTICS][-1].status for v in status.values}
    return said.get("clock jumps", "")


def series(listener: Listener) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """(time in s, values) of each signal."""
    imu, joints = listener.seen[names.IMU], listener.seen[names.JOINT_STATES]
    times = np.array([stamp(m) for m in imu])
    turn = np.array([[o.w, o.x, o.y, o.z] for o in (m.orientation for m in imu)])
    contacts = listener.seen[names.FOOT_CONTACTS]
    return {
        "tilt": (times, roll_pitch_yaw(turn)[:, :2]),
        "contacts": (np.array([stamp(m) for m in contacts]), np.array([m.contact for m in contacts], float)),
        "joints": (np.array([stamp(m) for m in joints]), np.array([m.position for m in joints])),
        "rates": (times, np.array([[v.x, v.y, v.z] for v in (m.angular_velocity for m in imu)])),
        "forces": (times, np.array([[v.x, v.y, v.z] for v in (m.linear_acceleration for m in imu)])),
    }


def at(recording: dict[str, tuple[np.ndarray, np.ndarray]], signal: str, times: np.ndarray) -> np.ndarray:
    own, values = recording[signal]
    return np.stack([np.interp(times, own, column) for column in values.T], axis=-1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("node", NODES)
def test_both_go_limp_in_silence_and_obey_the_emergency_stop(start_graph, peer, port, tmp_path, node):
    start_graph(process(node, port, tmp_path / "store"))
    listener = Listener(peer)
    listener.reset()
    listener.play(np.zeros((4, len(names.JOINTS))))
    said = listener.seen[names.DIAGNOSTICS]
    peer.wait_until(lambda: any("no command in time" in s.message for s in said[-1].status), "the silence to be told")
    assert peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger).success
    refused = peer.call(names.RESET_EPISODE, ResetEpisode.Request(), ResetEpisode)
    assert not refused.success and "release" in refused.message
    assert peer.call(names.RELEASE_EMERGENCY_STOP, Trigger.Request(), Trigger).success
    assert "no emergency stop" in peer.call(names.RELEASE_EMERGENCY_STOP, Trigger.Request(), Trigger).message
    listener.reset()
