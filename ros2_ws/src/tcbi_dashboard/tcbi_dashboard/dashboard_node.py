"""The page as a node of the graph: it listens, and asks for what the page's buttons say."""

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tcbi_contract import names
from tcbi_contract.messages import LATCHED_QOS, STREAM_QOS
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import guarded
from tcbi_dashboard.access import Access
from tcbi_dashboard.live import Live, Topic
from tcbi_dashboard.torque import RELEASED, RESET, STANDING, STOPPED, Torque, in_page_words
from tcbi_msgs.msg import FootContacts, RolloutEvent
from tcbi_msgs.srv import LoadPolicy, ResetEpisode

log = logging.getLogger(__name__)
NODES_S = 1.0  # between two looks at who is there
ANSWER_S = 3.0  # that a service has to answer
RESET_S = 20.0  # a robot moves slowly to its starting posture before it answers
OWN_SWITCH = "if it moves, use the switch on the robot"
EAR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)  # hears every publisher, and slows none down


@dataclass(frozen=True)
class DashboardParameters:
    """Parameters of the dashboard node."""

    host: str = parameter("localhost", "address to listen on; any other than localhost asks for a token")
    port: int = parameter(8080, "port to listen on", 1, 65535)
    allow_motion: bool = parameter(False, "whether a page on another address than localhost may move the robot")
    store: str = parameter("", "root of the model store; empty for the default")
    rollouts: str = parameter("", "folders of bags besides the store's own, with : between them")


class DashboardNode(Node):
    """Fills a `Live` with what it hears."""

    def __init__(self, live: Live, **more: Any) -> None:
        super().__init__("dashboard_node", **more)
        self._live = live
        live.namespace = self.get_namespace()
        self._sensed: Time | None = None  # stamp of the last joint_states: a simulation's time may be its own
        self._hear(names.JOINT_STATES, JointState, names.SENSOR_RATE_HZ, self._joints)
        self._hear(names.IMU, Imu, names.SENSOR_RATE_HZ, self._imu)
        self._hear(names.FOOT_CONTACTS, FootContacts, names.SENSOR_RATE_HZ, self._contacts)
        self._hear(names.TRACKER_POSE, PoseStamped, None, lambda _: None)
        self._hear(names.JOINT_COMMANDS, JointTrajectory, names.CONTROL_RATE_HZ, lambda _: None)
        self._hear(names.DIAGNOSTICS, DiagnosticArray, None, self._diagnostics)
        self.create_subscription(RolloutEvent, names.ROLLOUT_EVENT, self._event, LATCHED_QOS)
        self.create_subscription(String, names.POLICY_STATUS, self._policy, LATCHED_QOS)
        self._stop = self.create_client(Trigger, names.EMERGENCY_STOP)
        self._release = self.create_client(Trigger, names.RELEASE_EMERGENCY_STOP)
        self._reset = self.create_client(ResetEpisode, names.RESET_EPISODE)
        self._load = self.create_client(LoadPolicy, names.LOAD_POLICY)
        self._own = self.get_fully_qualified_name()
        self._health = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, STREAM_QOS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=steady)
        threading.Thread(target=self._look_around, name="dashboard-nodes", daemon=True).start()
        live.emergency_stop = self._stop_robot
        live.release = self._release_robot
        live.reset = self._reset_robot
        live.load_policy = lambda policy: self._ask(self._load, LoadPolicy.Request(policy=policy), "the policy node")

    def _hear(self, topic: str, kind: type, rate_hz: float | None, take: Callable[[Any], None]) -> None:
        self._live.topics[topic] = Topic(topic, rate_hz)

        def heard(message: Any) -> None:
            if not self._is_own(message):
                self._live.heard(topic)
                take(message)

        self.create_subscription(kind, topic, heard, EAR)

    def _is_own(self, message: Any) -> bool:
        """Whether this node has said it: what it hears of itself is no sign of a graph."""
        return isinstance(message, DiagnosticArray) and all(s.name == self.get_name() for s in message.status)

    def _joints(self, message: JointState) -> None:
        self._sensed = message.header.stamp
        with self._live.lock:
            self._live.joint_names, self._live.joint_position = tuple(message.name), tuple(message.position)

    def _imu(self, message: Imu) -> None:
        o = message.orientation
        with self._live.lock:
            self._live.attitude = None if message.orientation_covariance[0] < 0 else (o.w, o.x, o.y, o.z)

    def _contacts(self, message: FootContacts) -> None:
        with self._live.lock:
            self._live.foot_names, self._live.contact = tuple(message.name), tuple(message.contact)

    def _diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            values = {pair.key: pair.value for pair in status.values}
            self._live.diagnosed(status.name, level, status.message, values)

    def _diagnose(self) -> None:
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name=self.get_name(), message="listens")
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._sensed or self.get_clock().now().to_msg()
        self._health.publish(array)

    def _event(self, message: RolloutEvent) -> None:
        self._live.rollout = message.rollout_id if message.kind == RolloutEvent.BEGIN else ""

    def _policy(self, message: String) -> None:
        self._live.policy = message.data

    def _look_around(self) -> None:
        """Who is there; in a thread of its own, since no clock of a simulation should have to tick for it."""
        pause = threading.Event()
        self._live.on_close(pause.set)
        while not pause.wait(NODES_S):
            try:
                found = self.get_node_names_and_namespaces()
            except RuntimeError:  # the node has gone
                return
            full = {f"{space.rstrip('/')}/{name}" for name, space in found if not name.startswith("_")}
            self._live.nodes = tuple(sorted(full - {self._own}))

    def _stop_robot(self) -> str:
        done, said = self._told(self._stop, Trigger.Request(), STOPPED)
        return "STOPPED: torque is off." if done else f"{said}; {OWN_SWITCH}"

    def _release_robot(self) -> str:
        done, said = self._told(self._release, Trigger.Request(), RELEASED)
        return f'Released. The torque stays off until "{RESET}".' if done else said

    def _reset_robot(self) -> str:
        done, said = self._told(self._reset, ResetEpisode.Request(), STANDING, RESET_S)
        return "The robot has taken its starting posture." if done else said

    def _told(self, client: Any, request: Any, then: Torque, patience_s: float = ANSWER_S) -> tuple[bool, str]:
        """Ask the robot; once it has done so, its torque is known before its next diagnostics."""
        done, said = self._answer(client, request, "the robot", patience_s)
        if done:
            self._live.note_torque(then)
        return done, said

    def _ask(self, client: Any, request: Any, whom: str) -> str:
        """Call a service from another thread; returns what it answered, or that it did not."""
        done, said = self._answer(client, request, whom)
        return said or ("done" if done else "refused")

    def _answer(self, client: Any, request: Any, whom: str, patience_s: float = ANSWER_S) -> tuple[bool, str]:
        """Whether a service did what was asked, and what it said, in the page's words."""
        if not client.service_is_ready():
            return False, f"{whom} is not there: nobody offers {client.srv_name}; start the graph with ./tcbi up"
        answered = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(patience_s):
            return False, f"{whom} did not answer within {patience_s:g} s"
        answer = future.result()
        return bool(answer.success), in_page_words(answer.message)


def listen(live: Live, namespace: str = "") -> None:
    """Start the node in a background thread; it ends with `live.close`."""
    context = rclpy.Context()
    rclpy.init(context=context)
    _spin(DashboardNode(live, context=context, namespace=namespace.strip("/") or None), live)


def _spin(node: Node, live: Live) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    thread = threading.Thread(target=spin, name="dashboard-node", daemon=True)
    thread.start()

    def close() -> None:
        executor.shutdown(timeout_sec=1.0)
        thread.join(2.0)
        node.destroy_node()
        rclpy.try_shutdown(context=node.context)

    live.on_close(close)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of the node as a process: the server has the main thread, and ends on Ctrl-C."""
    live = Live()
    try:
        return guarded("dashboard_node", lambda: _serve(live, args))
    finally:
        live.close()


def _serve(live: Live, args: Sequence[str] | None) -> None:
    from tcbi_dashboard.server import serve
    from tcbi_dashboard.workbench import Workbench
    from tcbi_sim.store import ModelStore

    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.init(args=list(args) if args is not None else None, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        node = DashboardNode(live)
        values = declare(node, DashboardParameters)
        _spin(node, live)
        store = ModelStore(values.store or None)
        access = Access.of(values.host, values.port, values.allow_motion)
        folders = [store.root / "rollouts", *(Path(f).expanduser() for f in values.rollouts.split(":") if f)]
        say = node.get_logger().info
        serve(Workbench(store, folders, access), live, started=lambda: say(f"open {' or '.join(access.addresses)}"))
