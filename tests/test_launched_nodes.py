"""The launcher with a real node."""

import signal
import subprocess
import sys
import time

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from tcbi_bringup.graph_monitor import GraphMonitor
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract.names import ROBOT_DESCRIPTION

pytestmark = pytest.mark.graph
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def description(**more) -> NodeProcess:
    return NodeProcess("tcbi_sim", "description_node", **more)


def test_a_node_killed_comes_back_and_publishes_again(start_graph, peer):
    graph = start_graph(description(), restart=True)
    got = peer.collect(ROBOT_DESCRIPTION, String, LATCHED)
    peer.wait_until(lambda: len(got) == 1, "the description")
    graph.send_signal("description_node", signal.SIGKILL)
    peer.wait_until(lambda: len(got) == 2, "the description of the restarted node")
    assert got[0] == got[1]


def test_a_namespace_moves_the_topics(start_graph, peer):
    start_graph(description(namespace="left"))
    got = peer.collect("/left/robot_description", String, LATCHED)
    peer.wait_until(lambda: len(got) == 1, "the description under its namespace")


def test_a_wrong_parameter_ends_a_node_with_one_line_and_status_1(start_graph):
    graph = start_graph(description(parameters={"rgi": "hexapod"}), wait=False)
    assert graph.wait_for_exit("description_node", 40.0) == 1
    assert "unknown parameter 'rgi'" in graph.tail("description_node")


def test_the_monitor_counts_rates_and_ages(domain, peer):
    publisher = peer.node.create_publisher(String, "ticks", 10)
    peer.node.create_timer(0.05, lambda: publisher.publish(String(data="x")))
    with GraphMonitor(domain) as monitor:
        monitor.watch({"ticks": "std_msgs/msg/String", "silent": "std_msgs/msg/String"})
        peer.wait_until(lambda: monitor.rates()["ticks"].rate_hz > 0, "a first rate")
        began = time.monotonic()
        peer.wait_until(lambda: time.monotonic() > began + 2.0, "two seconds of ticks")
        rates = monitor.rates()
    assert rates["ticks"].publishers == 1
    assert 5 < rates["ticks"].rate_hz < 40  # 20, on a machine that may be busy
    assert rates["silent"].age_s is None and rates["silent"].rate_hz == 0


def test_a_node_that_hangs_when_it_is_told_to_end_says_where_and_ends(domain):
    code = (
        "import time; from rclpy.node import Node; from tcbi_contract import running\n"
        "running.ENDING_S = 0.5\n"
        "def hang(): print('hangs', flush=True); time.sleep(600)\n"
        "def make(): node = Node('hanging'); node.create_timer(0.1, hang); return node\n"
        "raise SystemExit(running.run('hanging', make))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as node:
        assert node.stdout is not None and node.stdout.readline() == "hangs\n"
        node.send_signal(signal.SIGTERM)
        _, error = node.communicate(timeout=60)
    assert node.returncode == 1 and "in hang" in error
