"""The launcher with a real node."""

import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from tcbi_bringup import launcher
from tcbi_bringup.domain_lock import hold_domain
from tcbi_bringup.errors import SecondGraphError
from tcbi_bringup.graph_monitor import GraphMonitor
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract.messages import STREAM_QOS
from tcbi_contract.names import DIAGNOSTICS, ROBOT_DESCRIPTION
from tcbi_contract.running import CRASHED

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


def test_it_tells_its_health(start_graph, peer):
    start_graph(description())
    heard = peer.collect(DIAGNOSTICS, DiagnosticArray, STREAM_QOS)
    peer.wait_until(lambda: len(heard) >= 2, "two diagnostics")
    (status,) = heard[-1].status
    assert (status.level, status.name, status.message) == (DiagnosticStatus.OK, "description_node", "published")
    assert status.values[0].value == "hexapod"


def test_the_laboratory_says_in_its_health_that_no_robot_is_there(start_graph, peer, tmp_path):
    start_graph(NodeProcess("tcbi_bringup", "experimenter_node", parameters={"socket": str(tmp_path / "nobody")}))
    heard = peer.collect(DIAGNOSTICS, DiagnosticArray, STREAM_QOS)
    peer.wait_until(lambda: any(m.status[0].level == DiagnosticStatus.ERROR for m in heard), "the fault")
    assert heard[-1].status[0].name == "experimenter_node" and "nobody" in heard[-1].status[0].message


def test_a_namespace_moves_the_topics(start_graph, peer):
    start_graph(description(namespace="left"))
    got = peer.collect("/left/robot_description", String, LATCHED)
    peer.wait_until(lambda: len(got) == 1, "the description under its namespace")


def test_a_wrong_parameter_ends_a_node_with_one_line_and_status_1(start_graph):
    graph = start_graph(description(parameters={"rgi": "hexapod"}), wait=False)
    assert graph.wait_for_exit("description_node", 40.0) == 1
    assert "unknown parameter 'rgi'" in graph.tail("description_node")


CRASHING = """
import sys
from rclpy.node import Node
from tcbi_contract.errors import TcbiError
from tcbi_contract.running import run

class Crashing(Node):
    def __init__(self):
        super().__init__("crashing")
        if "start" in sys.argv:
            raise ValueError("broken at the start")
        self.create_timer(0.05, self.work)

    def work(self):
        if "callback" in sys.argv:
            raise KeyError("broken later")
        raise TcbiError("no such port")

    def destroy_node(self):
        if "twice" in sys.argv:
            raise OSError("broken at the end")
        super().destroy_node()

raise SystemExit(run("crashing", Crashing, [], threads=2 if "threads" in sys.argv else 1))
"""


@pytest.mark.parametrize(
    ("how", "status", "last_words"),
    [
        ("start", CRASHED, "ValueError: broken at the start"),
        ("callback", CRASHED, "KeyError: 'broken later'"),
        ("callback threads", CRASHED, "KeyError: 'broken later'"),
        ("callback twice", CRASHED, "OSError: broken at the end"),
        ("set-up", 1, "crashing: no such port"),
        ("set-up twice", 1, "OSError: broken at the end"),
    ],
)
def test_a_node_that_crashes_shows_its_traceback_and_is_told_from_one_set_up_wrongly(domain, how, status, last_words):
    ended = subprocess.run(
        [sys.executable, "-c", CRASHING, *how.split()], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == status
    assert ended.stderr.strip().splitlines()[-1] == last_words
    assert ("Traceback" in ended.stderr) == (how != "set-up")


@dataclass(frozen=True)
class Crashing(NodeProcess):
    """The node above."""

    def command(self, after_crash: bool = False) -> list[str]:
        return [sys.executable, "-c", CRASHING, *self.arguments]


def test_a_node_that_crashes_is_started_again_more_often_than_one_set_up_wrongly(start_graph, peer, monkeypatch):
    monkeypatch.setattr(launcher, "FIRST_PAUSE_S", 0.01)
    crashing = Crashing("", "crashing", arguments=("callback",), ros=False)
    graph = start_graph(crashing, restart=True)
    peer.wait_until(lambda: graph.status()[0].state == "given up", "giving up")
    assert graph.status()[0].restarts == launcher.TRIES - 1
    assert graph.status()[0].reason.endswith("exit status 70: KeyError: 'broken later'")


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


def told_to_end(code: str, says: str) -> tuple[int, str]:
    """Status and standard error of a node made by `code` that is told to end once it has said something."""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as node:
        assert node.stdout is not None and node.stdout.readline() == f"{says}\n"
        node.send_signal(signal.SIGTERM)
        _, error = node.communicate(timeout=60)
    return node.returncode, error


def test_a_node_that_hangs_when_it_is_told_to_end_says_where_and_ends(domain):
    code = (
        "import time; from rclpy.node import Node; from tcbi_contract import running\n"
        "running.ENDING_S = 0.5\n"
        "def hang(): print('hangs', flush=True); time.sleep(600)\n"
        "def make(): node = Node('hanging'); node.create_timer(0.1, hang); return node\n"
        "raise SystemExit(running.run('hanging', make))\n"
    )
    status, error = told_to_end(code, "hangs")
    assert status == 1 and "in hang" in error


@pytest.mark.parametrize(("holds", "status"), [(False, 0), (True, 0), (True, 1)])
def test_a_middleware_that_does_not_let_go_costs_a_node_neither_its_end_nor_its_status(domain, tmp_path, holds, status):
    """`holds`: with the interpreter in its hands, so that nothing of Python goes on."""
    code = (
        "import ctypes, sys, time; from rclpy.node import Node; from tcbi_contract import running\n"
        "from tcbi_contract.errors import TcbiError\n"
        "running.PARTING_S = 2.0\n"
        "def held():\n"
        f"    while True: {'ctypes.PyDLL(None).sleep(600)' if holds else 'time.sleep(600)'}\n"  # a signal ends a sleep
        "class Held(Node):\n"
        "    def __init__(self): super().__init__('held'); self.create_timer(0.1, self.work)\n"
        f"    def work(self): print('works', flush=True); {'raise TcbiError(chr(120))' if status else 'pass'}\n"
        f"    def leave(self): open({str(tmp_path / 'left')!r}, 'w').close()\n"
        "    def destroy_node(self): held()\n"
        "raise SystemExit(running.run('held', Held))\n"
    )
    ended, error = told_to_end(code, "works")
    assert ended == status and (tmp_path / "left").exists()
    assert "in destroy_node" in error, "where it hung"


def test_a_domain_is_held_also_where_the_users_runtime_folder_is_not_there(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with hold_domain(231), pytest.raises(SecondGraphError, match="already runs in ROS domain 231"), hold_domain(231):
        pass
