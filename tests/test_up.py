"""`./tcbi up`, `run` and `doctor` as a user calls them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract.messages import LATCHED_QOS, STREAM_QOS
from tcbi_contract.names import JOINT_STATES, JOINTS, POLICY_STATUS
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_sim.measurement import Commands, Measurement, Scenario

pytestmark = [pytest.mark.graph, pytest.mark.timeout(600)]
TCBI = [sys.executable, "-P", "-m", "tcbi_bringup.cli"]
DEADLINE_S = 150.0


class Call:
    """One running `./tcbi …`, its output in a file."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self.output = folder / f"{words[0]}-{time.monotonic_ns()}.txt"
        with self.output.open("w") as file:
            self.process = subprocess.Popen([*TCBI, *words], stdout=file, stderr=subprocess.STDOUT)

    def text(self) -> str:
        return self.output.read_text()

    def wait_for(self, pattern: str) -> re.Match:
        deadline = time.monotonic() + DEADLINE_S
        while not (found := re.search(pattern, self.text(), re.MULTILINE)):
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline, f"no {pattern!r} in\n{self.text()}"
            time.sleep(0.05)
        return found

    def end(self, kind: int = signal.SIGINT) -> int:
        self.process.send_signal(kind)
        return self.process.wait(DEADLINE_S)


def answered(*words: str, typed: str = "") -> subprocess.CompletedProcess:
    """One `./tcbi …` to its end, which must be good."""
    result = subprocess.run(
        [*TCBI, *words], input=typed, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert result.returncode == 0, result.stderr
    return result


@pytest.fixture
def call(domain: int, tmp_path: Path) -> Iterator:
    """`call("up", …)` starts the command in the test's domain; what still runs at the end is killed."""
    calls: list[Call] = []

    def start(*words: str) -> Call:
        calls.append(Call(list(words), tmp_path))
        return calls[-1]

    yield start
    for one in calls:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_up_starts_the_graph_and_ends_it_without_leaving_a_process(call, peer, tmp_path, kind):
    up = call("up", "--no-learning", "--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"))
    got = peer.collect(JOINT_STATES, JointState, STREAM_QOS)
    peer.wait_until(lambda: len(got) > 50, "a second of joint states")
    for name in ("policy_node", "recorder_node"):
        up.wait_for(rf"^{name}: running")
    pids = [int(pid) for pid in re.findall(r"running, pid (\d+)", up.text())]
    assert up.end(kind) == 0, up.text()
    assert re.search(r"all \d processes stopped", up.text())
    assert len(pids) >= 4 and not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def test_up_drives_an_emulated_robot_and_a_rollout_of_it_is_recorded(call, tmp_path):
    bags = tmp_path / "bags"
    where = ("--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"), "--bags", str(bags))
    up = call("up", "--robot", "emulated", "--hidden", "none", "--policy", "gait:tripod", "--no-learning", *where)
    up.wait_for("^recorder_node: running")
    told = answered("collect", "--duration", "2", "--slope-roll", "0.1", "--json")
    (bag,) = json.loads(told.stdout)["bags"]
    measured = read_measurement(bag)
    assert (Path(bag).parent, measured.source, measured.policy_id) == (bags, "driver", "gait:tripod")
    assert measured.scenario.slope_roll == pytest.approx(0.1)
    assert np.ptp(measured.joint_position, axis=0).max() > 0.2 and np.isfinite(measured.distance)
    assert up.end() == 0, up.text()


def test_a_robot_at_a_port_is_placed_by_hand_and_its_distance_typed_in(call, start_graph, tmp_path):
    port, bags = tmp_path / "robot.port", tmp_path / "bags"
    arguments = ("--seed", "3", "--hidden", "none", "--link-path", str(port), "--socket", str(tmp_path / "sock"))
    start_graph(NodeProcess("tcbi_bringup", "emulated_robot", arguments=arguments, ros=False), wait=False)
    deadline = time.monotonic() + DEADLINE_S
    while not port.exists():
        assert time.monotonic() < deadline, "no port"
        time.sleep(0.05)
    where = ("--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"), "--bags", str(bags))
    up = call("up", "--robot", str(port), "--policy", "gait:tripod", "--no-learning", *where)
    up.wait_for("^recorder_node: running")
    words = ("collect", "--duration", "2", "--slope-pitch", "0.1", "--place", "--ask-distance")
    told = answered(*words, typed="\n" + "far\n" + "0.12\n")  # placed, no number, a distance
    assert "pitch 5.7 degrees" in told.stderr and "'far' is no number" in told.stderr
    measured = read_measurement(told.stdout.strip())
    assert measured.distance == 0.12 and measured.scenario.slope_pitch == pytest.approx(0.1)
    assert up.end() == 0, up.text()


def test_a_replay_feeds_a_graph_without_a_robot(call, peer, tmp_path):
    time = np.arange(100) * 0.02
    position = np.sin(time)[:, None] * np.ones(18)
    commands = Commands(np.array([0.0]), np.zeros((1, 18)))
    scenario = Scenario("balance", float(time[-1]))
    made = Measurement("made", "hexapod", scenario, "", "driver", commands, JOINTS, (), time, position)
    bag, copies = write_measurement(tmp_path / "bags", made), tmp_path / "copies"
    where = ("--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"), "--bags", str(copies))
    up = call("up", "--robot", "none", "--no-learning", *where)
    acting = peer.collect(POLICY_STATUS, String, LATCHED_QOS)
    peer.wait_until(lambda: peer.node.count_subscribers(JOINT_STATES) == 3, "policy, recorder, and up's own look")
    peer.wait_until(lambda: bool(acting), "the policy")
    answered("replay", str(bag), "--wait-for", "3")
    peer.wait_until(lambda: (copies / "made").is_dir(), "the recorder's copy of the rollout")
    copy = read_measurement(copies / "made")
    assert (copy.rollout_id, copy.source, len(copy.commands.time)) == ("made", "driver", 1)
    np.testing.assert_array_equal(copy.joint_position, read_measurement(bag).joint_position)
    assert up.end() == 0, up.text()
    assert "sim_node" not in up.text() and "driver_node" not in up.text() and "no robot: ROS domain" in up.text()


def test_a_second_up_in_the_same_domain_is_refused_in_one_line(call, tmp_path):
    first = call("up", "--no-learning", "--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"))
    first.wait_for("^sim_node: running")
    second = call("up", "--store", str(tmp_path / "store"))
    assert second.process.wait(DEADLINE_S) == 1
    assert len(second.text().strip().splitlines()) == 1
    assert f"already runs in ROS domain {os.environ['ROS_DOMAIN_ID']} (process {first.process.pid})" in second.text()
    assert first.end() == 0


def test_up_is_refused_beside_nodes_that_another_launcher_started(call, start_graph):
    start_graph(NodeProcess("tcbi_sim", "sim_node"))
    second = call("up")
    assert second.process.wait(DEADLINE_S) == 1
    assert "found /sim_node" in second.text()


def test_up_without_its_robot_says_why_and_ends_with_1(call, tmp_path):
    damaged = tmp_path / "store" / "models" / "hexapod-v1" / "model.json"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("{")
    up = call("up", "--store", str(tmp_path / "store"), "--log-dir", str(tmp_path / "log"))
    assert up.process.wait(DEADLINE_S) == 1
    last = up.text().strip().splitlines()[-1]
    assert last.startswith("tcbi: sim_node failed 2 times in a row") and "hexapod-v1" in last
    assert up.text().count("cannot read the model") == 1 and str(tmp_path / "log") in last


def test_up_with_a_model_that_is_not_there_is_refused_at_once(call, tmp_path):
    up = call("up", "--model", "hexapod-v99", "--store", str(tmp_path))
    assert up.process.wait(DEADLINE_S) == 2
    assert len(up.text().strip().splitlines()) == 1 and "hexapod-v99" in up.text()


def test_run_hands_the_process_over_to_the_node(call):
    node = call("run", "tcbi_sim", "description_node", "--ros-args", "-p", "rig:=hexapod")
    node.wait_for("description of hexapod")
    assert node.end() == 0


def test_doctor_finds_a_running_graph_well(start_graph, domain, tmp_path):
    start_graph(NodeProcess("tcbi_sim", "sim_node"))
    words = [*TCBI, "doctor", "--json", "--store", str(tmp_path)]
    deadline = time.monotonic() + DEADLINE_S
    while True:  # on a busy machine the doctor's seconds may not be enough to discover a node
        result = subprocess.run(words, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
        report = json.loads(result.stdout)
        found = {check["name"]: check for check in report["checks"]}
        if found["graph"]["found"] == "sim_node":
            break
        assert time.monotonic() < deadline, found["graph"]
    assert found["topic joint_states"]["status"] in ("ok", "warning"), "a busy machine may slow it down"
    assert "1 publisher" in found["topic joint_states"]["found"]
    assert report["faults"] == sum(check["status"] == "fault" for check in report["checks"])
    assert result.returncode == (1 if report["faults"] else 0)
