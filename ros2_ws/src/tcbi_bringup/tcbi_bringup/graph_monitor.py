"""Looks at a running graph from outside: its nodes, the rate and age of each topic, what is not well; needs ROS.

with GraphMonitor(domain_id=7) as monitor:
    monitor.wait_for_nodes(["sim_node", "policy_node"], timeout_s=10)
    monitor.watch({"joint_states": "sensor_msgs/msg/JointState"})
    monitor.rates()["joint_states"].rate_hz
    monitor.watch_health()
    [complaint.message for complaint in monitor.complaints()]
"""

import collections
import importlib
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tcbi_bringup.errors import LaunchError
from tcbi_contract.names import DIAGNOSTICS

WINDOW = 200  # arrivals that a rate is taken over
WINDOW_S = 5.0
POLL_S = 0.05
LOOK_ON_QOS = QoSProfile(
    depth=50, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)  # accepts every publisher, and never slows one down
LEVELS = {1: "warning", 2: "error", 3: "stale"}  # of diagnostic_msgs/DiagnosticStatus; 0 is well
OLD_S = 3.0  # diagnostics come once a second


@dataclass(frozen=True)
class TopicRate:
    """Arrivals of one topic: rate over the last seconds, and how long ago the last message came (s, None if never)."""

    topic: str
    publishers: int
    rate_hz: float
    age_s: float | None


@dataclass(frozen=True)
class Complaint:
    """What one source of the diagnostics says that is not well; its level is a word of LEVELS."""

    source: str
    level: str
    message: str


class GraphMonitor:
    """A node of its own, spinning in a thread. A context manager."""

    def __init__(self, domain_id: int | None = None, namespace: str = "", name: str = "graph_monitor") -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node(
            name,
            context=self._context,
            namespace=namespace or None,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._lock = threading.Lock()
        self._arrivals: dict[str, collections.deque[float]] = {}
        self._complaints: dict[str, tuple[Complaint, float]] = {}  # by source, with the time heard (monotonic s)
        self._thread = threading.Thread(target=self._spin, name="graph-monitor", daemon=True)

    def __enter__(self) -> "GraphMonitor":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        rclpy.shutdown(context=self._context)
        self._thread.join()
        self._node.destroy_node()

    def node_names(self) -> set[str]:
        """Full names of all nodes in the domain but this one."""
        own = self._node.get_fully_qualified_name()
        found = {
            f"{space.rstrip('/')}/{name}"
            for name, space in self._node.get_node_names_and_namespaces()
            if not name.startswith("_")
        }
        return found - {own}

    def wait_for_nodes(self, names: Iterable[str], timeout_s: float) -> None:
        """Wait until all nodes are there (names as given in the graph, with or without namespace).

        Raises:
          LaunchError: some are not there at the deadline.
        """
        wanted, deadline = set(names), time.monotonic() + timeout_s
        while missing := {name for name in wanted if not self._has(name)}:
            if time.monotonic() > deadline:
                raise LaunchError(f"not there after {timeout_s:g} s: {', '.join(sorted(missing))}")
            time.sleep(POLL_S)

    def publishers(self, topic: str) -> int:
        """Number of publishers of a topic."""
        return self._node.count_publishers(topic)

    def topic_types(self) -> dict[str, list[str]]:
        """Type names of each topic in the domain, by full name."""
        return dict(self._node.get_topic_names_and_types())

    def watch(self, topics: Mapping[str, str]) -> None:
        """Start counting the messages of topics, given with their type, e.g. "sensor_msgs/msg/Imu"."""
        for topic, type_name in topics.items():
            if topic not in self._arrivals:
                arrivals: collections.deque[float] = collections.deque(maxlen=WINDOW)
                self._arrivals[topic] = arrivals
                kind = message_class(type_name)
                self._node.create_subscription(kind, topic, partial(self._arrived, arrivals), LOOK_ON_QOS, raw=True)

    def watch_health(self) -> None:
        """Start listening to the diagnostics."""
        self._node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._diagnosed, LOOK_ON_QOS)

    def rates(self) -> dict[str, TopicRate]:
        """What `watch` has counted, by topic."""
        now = time.monotonic()
        with self._lock:
            arrivals = {topic: list(times) for topic, times in self._arrivals.items()}
        return {
            topic: TopicRate(topic, self.publishers(topic), rate(times, now), now - times[-1] if times else None)
            for topic, times in arrivals.items()
        }

    def complaints(self) -> list[Complaint]:
        """What `watch_health` has heard in the last seconds that is not well, by source."""
        heard_since = time.monotonic() - OLD_S
        with self._lock:
            return [complaint for _, (complaint, heard) in sorted(self._complaints.items()) if heard > heard_since]

    def _diagnosed(self, message: DiagnosticArray) -> None:
        with self._lock:
            for status in message.status:
                level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                self._complaints.pop(status.name, None)
                if level in LEVELS:
                    complaint = Complaint(status.name, LEVELS[level], status.message)
                    self._complaints[status.name] = complaint, time.monotonic()

    def _arrived(self, arrivals: collections.deque[float], _: bytes) -> None:
        with self._lock:
            arrivals.append(time.monotonic())

    def _has(self, name: str) -> bool:
        nodes = self.node_names()
        return name in nodes or any(node.endswith(f"/{name.strip('/')}") for node in nodes)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return


def rate(times: list[float], now: float, window_s: float = WINDOW_S) -> float:
    """Messages per second over the last `window_s`, from arrival times in s; 0 for fewer than two."""
    recent = [t for t in times if t > now - window_s]
    return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 and recent[-1] > recent[0] else 0.0


def message_class(type_name: str) -> type:
    """The class of "package/msg/Name"."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)
