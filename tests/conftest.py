"""For tests that start node processes: a ROS domain of their own, a graph that must end cleanly, a peer to talk with.

@pytest.mark.graph
def test_something(start_graph, peer):
    graph = start_graph(NodeProcess("tcbi_sim", "sim_node", parameters={"mode": "lockstep"}))
    got = peer.collect("joint_states", JointState, STREAM_QOS)
    peer.wait_until(lambda: len(got) >= 10, "ten joint states")
"""

import contextlib
import gc
import time
from collections.abc import Callable, Iterator
from typing import Any

import domain_coordinator
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from tcbi_bringup.graph_monitor import GraphMonitor
from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_contract import names
from tcbi_contract.goals import SentGoal
from tcbi_msgs.srv import ResetEpisode
from tests.stalls import StalledMachine, StallWatch

DEADLINE_S = 90.0  # far beyond what is needed, for a machine that does much else
RESETS, RESET_PAUSE_S = 5, 1.0
ASK_AGAIN_S = 5.0  # after a goal that nothing is heard of: the middleware may lose an answer


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    """A test in real time that fails while the machine stands still is told apart, and run again."""
    if not any(pyfuncitem.get_closest_marker(name) for name in ("graph", "real_time")):
        return (yield)
    with StallWatch() as watch:
        try:
            return (yield)
        except (Exception, pytest.fail.Exception) as error:
            if not watch.stalled:
                raise
            raise StalledMachine(f"held up for {watch.longest_s:.2f} s, and {error}") from error


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other test uses meanwhile; ROS_DOMAIN_ID is set to it."""
    with domain_coordinator.domain_id() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


@contextlib.contextmanager
def ros_in_process(arguments: list[str]) -> Iterator[None]:
    """ROS for a node in the process of the test; nobody finds it in the domain any more once the test has let go of it.

    Its cycles of references would keep it there until they happened to be collected.
    """
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.shutdown()
        gc.collect()


@pytest.fixture
def start_graph(domain: int, tmp_path) -> Iterator[Callable[..., Graph]]:
    """`start_graph(process, …, restart=False)` starts processes and waits until each node is there.

    At the end all are stopped, and each that the test has not seen end itself (`wait_for_exit`) must exit with 0.
    """
    graphs: list[Graph] = []

    def start(*processes: NodeProcess, restart: bool = False, wait: bool = True) -> Graph:
        graph = Graph(processes, domain_id=domain, log_dir=tmp_path / f"log{len(graphs)}", restart=restart)
        graphs.append(graph.__enter__())
        if wait:
            wait_for_nodes(graph, processes, domain)
        return graph

    try:
        yield start
    finally:
        codes, logs = {}, ""
        for graph in graphs:
            running = [s.name for s in graph.status() if s.state == "running"]
            ended = graph.stop(*running) if running else {}
            codes.update(ended)
            logs += "".join(f"\n--- {name}\n{graph.tail(name, 30)}" for name, code in ended.items() if code)
            graph.__exit__(None, None, None)
    assert not any(codes.values()), f"exit codes {codes}{logs}"


def wait_for_nodes(graph: Graph, processes: tuple[NodeProcess, ...], domain: int) -> None:
    """Wait until the nodes of `processes` are discovered; fails at once when one of them ends."""
    names = {f"{p.namespace.strip('/')}/{p.key if p.rename else p.executable}" for p in processes if p.ros}
    deadline = time.monotonic() + DEADLINE_S
    with GraphMonitor(domain) as monitor:
        while missing := {n for n in names if not any(m.endswith("/" + n.strip("/")) for m in monitor.node_names())}:
            graph.check()
            assert time.monotonic() < deadline, f"nodes {missing} not there after {DEADLINE_S} s"
            time.sleep(0.05)


class Peer:
    """A node inside the test: collects messages, publishes, calls services."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node: Node = rclpy.create_node("peer", context=self._context)
        self.executor = SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)

    def collect(self, topic: str, kind: type, qos: QoSProfile | int, publishers: int = 0) -> list[Any]:
        """Subscribe, and wait for so many publishers; returns the list that messages go to while the peer waits."""
        messages: list[Any] = []
        subscription = self.node.create_subscription(kind, topic, messages.append, qos)
        self.wait_until(lambda: subscription.get_publisher_count() >= publishers, f"{publishers} on {topic}")
        return messages

    def publisher(self, topic: str, kind: type, qos: QoSProfile | int, subscribers: int = 1) -> Any:
        """A publisher that already has its subscribers."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait_until(lambda: publisher.get_subscription_count() >= subscribers, f"{subscribers} on {topic}")
        return publisher

    def call(self, service: str, request: Any, kind: type, timeout_s: float = DEADLINE_S) -> Any:
        """Call a service and wait for its answer."""
        client = self.node.create_client(kind, service)
        self.wait_until(client.service_is_ready, f"service {service}", timeout_s)
        for _ in range(2):  # the middleware drops the answer to a client that the service's end has not discovered yet
            future = client.call_async(request)
            if self.comes(future.done, timeout_s / 2):
                return future.result()
            client.remove_pending_request(future)
        raise AssertionError(f"{service} did not answer within {timeout_s:g} s")

    def reset(self, **fields: Any) -> Any:
        """A reset that succeeds, asked for again while a robot that a busy machine holds up says it is not ready."""
        for _ in range(RESETS):
            answer = self.call(names.RESET_EPISODE, ResetEpisode.Request(**fields), ResetEpisode)
            if answer.success:
                return answer
            self.comes(lambda: False, RESET_PAUSE_S)
        raise AssertionError(f"reset was refused {RESETS} times: {answer.message}")

    def send(
        self, client: Any, action: Any, goal: Any, heard: Callable[[Any], None] = lambda message: None
    ) -> SentGoal:
        """A goal that its server has taken or refused."""
        self.wait_until(client.server_is_ready, "the action's server")
        sent = SentGoal(client, action, goal, heard)
        self._ask(sent, lambda: sent.taken or sent.refused, "the answer to the goal", DEADLINE_S)
        return sent

    def end(self, sent: SentGoal, what: str, timeout_s: float = DEADLINE_S) -> Any:
        """Status and result of a goal."""
        self._ask(sent, lambda: sent.end is not None, what, timeout_s)
        return sent.end

    def _ask(self, sent: SentGoal, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        def comes() -> bool:
            if sent.wants_asking(ASK_AGAIN_S):
                sent.ask()
            return condition()

        self.wait_until(comes, what, timeout_s)

    def result(self, future: Any, what: str, timeout_s: float = DEADLINE_S) -> Any:
        """Wait for a future."""
        self.wait_until(future.done, what, timeout_s)
        return future.result()

    def wait_until(self, condition: Callable[[], bool], what: str, timeout_s: float = DEADLINE_S) -> None:
        """Spin until the condition holds; fails at the deadline, naming what was waited for."""
        assert self.comes(condition, timeout_s), f"{what}: not within {timeout_s:g} s"

    def comes(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Spin until the condition holds; tells whether it does."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.executor.spin_once(timeout_sec=0.02)
        return True

    def close(self) -> None:
        """End the node."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def peer(domain: int) -> Iterator[Peer]:
    """A node of the test's own in the test's domain."""
    made = Peer(domain)
    yield made
    made.close()
