"""A replay as fast as it goes: nothing is lost to a listener that keeps up."""

from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState

from tcbi_bringup.arguments import Parser
from tcbi_bringup.commands import replay
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_contract.names import JOINTS
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.scan import Scan
from tcbi_infer.replay_node import ReplayParameters
from tcbi_msgs.msg import RolloutEvent
from tcbi_sim.measurement import Commands, Measurement, Scenario

pytestmark = pytest.mark.graph

MINUTE = 3000  # samples
DEEP_QOS = QoSProfile(depth=MINUTE, reliability=ReliabilityPolicy.RELIABLE)  # keeps up, however busy the machine


def bag_of_a_minute(folder: Path) -> Path:
    time = np.arange(MINUTE) * 0.02
    position = np.sin(time)[:, None] * np.ones(18)
    attitude = np.tile([0.0, 0.0, 0.0, 1.0], (MINUTE, 1))
    commands = Commands(np.empty(0), np.empty((0, 18)))
    made = Measurement(
        "made", "hexapod", Scenario("balance", 60.0), "", "sim", commands, JOINTS, (), time, position, attitude
    )
    return write_measurement(folder, made)


@pytest.mark.parametrize(("option", "name"), [("--rate", "rate"), ("--wait-for", "wait_for")])
def test_the_command_allows_what_the_node_allows(option, name, capsys):
    parser = Parser()
    replay.add_arguments(parser)
    field = ReplayParameters.__dataclass_fields__[name]
    ends = field.metadata["low"], field.metadata["high"]
    assert [getattr(parser.parse_args(["bag", option, str(end)]), name) for end in ends] == list(ends)
    for beyond in (ends[0] - 1, ends[1] + 1):
        with pytest.raises(SystemExit):
            parser.parse_args(["bag", f"{option}={beyond}"])


def test_a_replay_that_nobody_listens_to_does_not_begin(start_graph, tmp_path):
    values = {"bag": str(bag_of_a_minute(tmp_path / "bags")), "wait_for": 2, "wait_timeout_s": 0.5}
    graph = start_graph(NodeProcess("tcbi_infer", "replay_node", parameters=values), wait=False)
    assert graph.wait_for_exit("replay_node", 40.0) == 1
    assert "0 of 2 nodes listen to /joint_states after 0.5 s; start them" in graph.tail("replay_node")


def test_nothing_is_lost_at_a_thousand_times_the_recorded_speed(start_graph, peer, tmp_path):
    bag = bag_of_a_minute(tmp_path)
    heard: dict[str, list[bytes]] = {}
    for kind, name, qos in (  # joints last, which the replay waits for: listeners are discovered in their order
        (RolloutEvent, names.ROLLOUT_EVENT, messages.LATCHED_QOS),
        (Imu, names.IMU, DEEP_QOS),
        (JointState, names.JOINT_STATES, DEEP_QOS),
    ):
        heard["/" + name] = []
        peer.node.create_subscription(kind, name, heard["/" + name].append, qos, raw=True)
    values = {"bag": str(bag), "rate": 1000.0, "wait_for": 1}
    graph = start_graph(NodeProcess("tcbi_infer", "replay_node", parameters=values), wait=False)
    played = {name: [] for name in heard}
    for message in Scan(bag / "made_0.mcap").messages():
        played[message.channel.topic].append(message.data)
    peer.wait_until(lambda: graph.status()[0].exit_code is not None, "the end of the replay")
    assert graph.wait_for_exit("replay_node", 5.0) == 0
    assert {name: len(got) for name, got in heard.items()} == {name: len(sent) for name, sent in played.items()}
    for name, sent in played.items():  # the middleware fills up what it sends to a multiple of four bytes
        assert [got[: len(data)] for got, data in zip(heard[name], sent, strict=True)] == sent
