"""Records every rollout of the graph as a bag, and runs the rollouts that `collect_rollouts` asks for.

It listens to the contract's topics as serialized bytes and writes what comes between BEGIN and END of `rollout/event`,
whoever publishes these. Killed at any moment, it loses half a second at most.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64, String

from tcbi_contract import messages, names
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_contract.wording import counted
from tcbi_infer.bags import schemas
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.bags.schemas import stamp_of
from tcbi_infer.collector import Collector
from tcbi_infer.errors import InferError, RecordingError
from tcbi_infer.interfaces import STREAMS
from tcbi_infer.recorder import Recorder
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.msg import RolloutEvent

FETCH_PERIOD_S = 0.03
QUEUE = 2000  # messages of one topic that may wait: ten seconds at 200 Hz


class Fetched(CallbackGroup):
    """Of subscriptions whose messages the node fetches: the executor leaves these alone."""

    def can_execute(self, entity: Any) -> bool:
        """Never."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Never."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing to do."""

    @staticmethod
    def never(_: bytes) -> None:
        """The callback of the subscriptions."""
        raise AssertionError("a message that should have been fetched was handed over")


@dataclass(frozen=True)
class RecorderParameters:
    """Parameters of the recorder node."""

    folder: str = parameter("rollouts", "where the bags go; one recorder a folder")
    flush_period_s: float = parameter(0.5, "how often what was recorded is made safe from a kill", low=0.05, high=5.0)
    min_free_mb: float = parameter(50.0, "free disk space without which no rollout begins, MB", low=0.0)
    service_timeout_s: float = parameter(20.0, "how long another node may take to answer", low=0.5, high=600.0)
    place_timeout_s: float = parameter(600.0, "how long a person may take to place the robot", low=1.0, high=86400.0)
    alone_timeout_s: float = parameter(
        25.0,
        "how long a second robot on the topics is waited out: one that was killed counts for 20 s",
        low=0.0,
        high=300.0,
    )
    silence_timeout_s: float = parameter(
        5.0, "wall time without joint_states that aborts a rollout", low=0.5, high=600.0
    )
    distance_timeout_s: float = parameter(
        0.0, "how long END waits for the operator's rollout/distance where no tracker runs; 0 does not wait", low=0.0
    )


class RecorderNode(Node):
    """Subscribes, records, and serves `collect_rollouts`; single-threaded."""

    def __init__(self) -> None:
        super().__init__("recorder_node")
        self.values = declare(self, RecorderParameters)
        schemas.prepare()
        self.folder = RecordingFolder(self.values.folder)
        for line in self.folder.repaired:
            self.get_logger().warning(line)
        self._calm = bool(self.folder.repaired)  # a rollout was cut off: whatever moved the robot may do so still
        self.recorder = Recorder(self.resolve_topic_name(names.ROLLOUT_EVENT))
        self.fault = ""  # the last failure of the disk
        self.lost = 0  # messages that the middleware dropped
        self.heard_joints_s = 0.0  # wall time
        self.commanded_ns = 0  # stamp of the last command; where the rollout has none yet, its begin
        self.commanded = False  # whether the rollout has one
        self.bags: list[Path] = []
        self.poses: list[bytes] = []  # first and newest of the present rollout
        self.distance: float | None = None  # the operator's entry
        self.takes_distance = False  # the robot has come to the rollout's end
        self.policy_id = ""  # of the policy that is loaded, as far as it is known
        self._foreign_end: bytes | None = None
        self._newest: dict[str, bytes] = {}  # by topic
        self._listen()
        self.events = self.create_publisher(RolloutEvent, names.ROLLOUT_EVENT, messages.LATCHED_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, messages.STREAM_QOS)
        self.collector = Collector(self)
        self._server = ActionServer(
            self,
            CollectRollouts,
            names.COLLECT_ROLLOUTS,
            self.collector.run,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self.values.flush_period_s, self._on_flush, clock=steady)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=steady)
        self.create_timer(FETCH_PERIOD_S, self._on_tick, clock=steady)
        self.get_logger().info(f"records into {self.folder.path.resolve()}")

    # -- listening ------------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        self._streams: dict[str, Any] = {}  # by full name
        lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
        qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=QUEUE, reliability=ReliabilityPolicy.RELIABLE)
        fetched = Fetched()
        for name, message_type in STREAMS.items():
            self._streams[self.resolve_topic_name(name)] = self.create_subscription(
                message_type, name, Fetched.never, qos, callback_group=fetched, raw=True, event_callbacks=lost
            )
        self.create_subscription(RolloutEvent, names.ROLLOUT_EVENT, self._on_event, messages.LATCHED_QOS, raw=True)
        self.create_subscription(Float64, names.DISTANCE, self._on_distance, 10)
        self.create_subscription(String, names.POLICY_STATUS, self._on_policy, messages.LATCHED_QOS)

    def fetch(self) -> None:
        """Take all messages that wait; a wait set for each would cost more than ten messages."""
        for topic, stream in self._streams.items():
            while True:
                with stream.handle:
                    found = stream.handle.take_message(stream.msg_type, True)
                if found is None:
                    break
                data, info = found
                self._take(topic, data, info["received_timestamp"])

    def _take(self, topic: str, data: bytes, received: int) -> None:
        """One message; `received` is when the middleware had it (ns), however long this node was busy then."""
        stamp = stamp_of(data) or 0
        now = self.get_clock().now().nanoseconds if self.simulated_time else received
        if stamp <= 0:
            stamp = now
        elif self._newest.get(topic) == data:
            return  # a simulation that waits repeats its present for late listeners
        self._newest[topic] = data
        if topic.endswith(names.JOINT_STATES):
            self.heard_joints_s = time.monotonic()
        if topic.endswith(names.JOINT_COMMANDS):
            self.commanded = self.commanded or stamp >= self.commanded_ns
            self.commanded_ns = max(self.commanded_ns, stamp)
        rollout = self.recorder.rollout
        if topic.endswith(names.TRACKER_POSE) and self._within(rollout, stamp):
            self.poses = [*self.poses[:1], data]
        log_time = stamp if self.simulated_time else now
        try:
            self.recorder.add(topic, stamp, log_time, data)
        except RecordingError as error:
            self.fail(error)

    @staticmethod
    def _within(rollout: Any, stamp: int) -> bool:
        return rollout is not None and rollout.begin <= stamp and (rollout.end is None or stamp <= rollout.end)

    @property
    def simulated_time(self) -> bool:
        """Whether this node's clock is /clock."""
        return bool(self.get_parameter("use_sim_time").value)

    def _on_lost(self, event: Any) -> None:
        self.lost += event.total_count_change
        self.get_logger().error(f"{counted(event.total_count_change, 'message')} lost on the way to the recorder")

    def _on_policy(self, message: String) -> None:
        self.policy_id = message.data

    def _on_distance(self, message: Float64) -> None:
        if self.takes_distance:  # one that comes too late is not the next rollout's
            self.distance = float(message.data)

    # -- rollouts -------------------------------------------------------------------------------------------------

    def _on_event(self, data: bytes) -> None:
        """An event of another node; what this one publishes it has recorded already."""
        event = deserialize_message(data, RolloutEvent)
        rollout = self.recorder.rollout
        stamp = stamp_of(data) or self.get_clock().now().nanoseconds
        if self.collector.is_own(event.rollout_id):
            return
        if event.kind == RolloutEvent.BEGIN:
            if self.collector.busy:
                self.get_logger().error(
                    f"BEGIN of {event.rollout_id!r} ignored: a collection runs; two graphs in one domain?"
                )
                return
            if rollout is not None and rollout.rollout_id != event.rollout_id:
                self._finish_foreign(serialize_message(_aborted(event, rollout, "the next rollout began")))
            if self.recorder.rollout is None:
                self.open(self.folder, event.rollout_id, stamp, data)
        elif rollout is not None and rollout.rollout_id == event.rollout_id:
            self.recorder.end(stamp, time.monotonic())
            self._foreign_end = data

    def open(self, folder: RecordingFolder, rollout_id: str, begin: int, data: bytes, end: int | None = None) -> None:
        """Begin a bag; a failure is said and shown in diagnostics."""
        self.distance, self.takes_distance, self._foreign_end = None, False, None
        self.commanded_ns, self.commanded = begin, False
        last = self._newest.get(self.resolve_topic_name(names.TRACKER_POSE), b"")
        self.poses = [last] if (stamp_of(last) or 0) >= begin else []  # a simulation that waits has shown its start
        try:
            self.recorder.begin(folder, rollout_id, begin, data, end, self.values.min_free_mb)
            self.fault = ""
        except InferError as error:
            self.fail(error)

    def close(self, event: RolloutEvent, end: int) -> Path | None:
        """Write the last event and finish the bag; None if the disk refuses it."""
        try:
            path = self.recorder.close(serialize_message(event), end)
        except InferError as error:
            self.fail(error)
            return None
        self.bags.append(path)
        self.get_logger().info(f"recorded {path}")
        return path

    def fail(self, error: InferError) -> None:
        """Say what went wrong, once, and show it in diagnostics from now on."""
        self.fault = " ".join(str(error).split())
        self.get_logger().error(self.fault)
        self._diagnose()

    def _on_tick(self) -> None:
        self.fetch()
        self._calm = self._calm and not self.collector.stop_policy()
        if self._foreign_end is not None and self.recorder.settled(time.monotonic()):
            self._finish_foreign(self._foreign_end)

    def _finish_foreign(self, data: bytes) -> None:
        self._foreign_end = None
        if self.recorder.rollout is not None:
            self.close(deserialize_message(data, RolloutEvent), stamp_of(data) or 0)

    def _on_flush(self) -> None:
        try:
            self.recorder.flush()
        except RecordingError as error:
            self.fail(error)

    def _on_goal(self, _: Any) -> GoalResponse:
        if self.collector.busy or self.recorder.rollout is not None:
            self.get_logger().warning(
                "collect_rollouts refused: a rollout is being recorded; cancel it, or wait for its end"
            )
            return GoalResponse.REJECT
        self.collector.busy = True
        return GoalResponse.ACCEPT

    # -- health ---------------------------------------------------------------------------------------------------

    def _diagnose(self) -> None:
        rollout = self.recorder.rollout
        status = DiagnosticStatus(name="recorder_node: recording", hardware_id=str(self.folder.path))
        status.level, status.message = DiagnosticStatus.OK, f"recording {rollout.rollout_id}" if rollout else "ready"
        if self.lost:
            status.level, status.message = DiagnosticStatus.WARN, f"{counted(self.lost, 'message')} lost"
        if self.fault:
            status.level, status.message = DiagnosticStatus.ERROR, self.fault
        facts = {
            "rollout": rollout.rollout_id if rollout else "none",
            "bags": len(self.bags),
            "messages received": self.recorder.received,
            "messages recorded": self.recorder.recorded,
            "messages lost": self.lost,
        }
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def leave(self) -> None:
        """Finish what is being recorded, as aborted."""
        self.fetch()
        rollout = self.recorder.rollout
        if rollout is not None:
            now = max(self.get_clock().now().nanoseconds, rollout.begin)
            event = _aborted(RolloutEvent(), rollout, "the recorder was stopped")
            event.header.stamp = messages.to_stamp(now)
            self.close(event, now)
        self.folder.close()


def _aborted(template: RolloutEvent, rollout: Any, why: str) -> RolloutEvent:
    event = RolloutEvent(rollout_id=rollout.rollout_id, kind=RolloutEvent.ABORT, distance=float("nan"), note=why)
    event.header.stamp = template.header.stamp
    return event


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("recorder_node", RecorderNode, args)
