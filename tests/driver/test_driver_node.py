"""The driver node as a process, in front of the emulated electronics: topics, services, exit codes."""

import dataclasses
import os
import signal

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.launcher import NodeProcess
from tcbi_bringup.robot_graph import AFTER_CRASH
from tcbi_contract import names
from tcbi_contract.messages import STREAM_QOS, joint_command, seconds
from tcbi_msgs.msg import Block, FootContacts
from tcbi_msgs.srv import ResetEpisode

pytestmark = pytest.mark.graph
ZERO = (0.0,) * 18
DEADLINE_S = 30.0


def _node(bench, **parameters) -> NodeProcess:
    ports = dict(zip(("port", "sensor_port"), bench.paths, strict=False))
    return NodeProcess("hexapod_driver", "driver_node", parameters={**ports, **parameters})


def _now(peer) -> Time:
    return peer.node.get_clock().now().to_msg()


@pytest.mark.parametrize("ports", [1, 2])
def test_the_topics_are_the_contracts(make_bench, start_graph, peer, ports: int):
    bench = make_bench(ports, position=0.1)
    start_graph(_node(bench))
    joints = peer.collect(names.JOINT_STATES, JointState, STREAM_QOS)
    imus = peer.collect(names.IMU, Imu, STREAM_QOS)
    feet = peer.collect(names.FOOT_CONTACTS, FootContacts, STREAM_QOS)
    tracker = peer.collect(names.TRACKER_POSE, PoseStamped, STREAM_QOS)
    peer.wait_until(lambda: min(len(joints), len(imus), len(feet)) >= 100, "two seconds of sensors")
    for messages in (joints, imus, feet):
        stamps = np.array([seconds(m.header.stamp) for m in messages])
        assert np.all(np.diff(stamps) > 0)
        assert np.median(np.diff(stamps)) == pytest.approx(0.02, abs=0.003)
    assert tuple(joints[0].name) == names.JOINTS
    assert joints[0].position == pytest.approx((0.1,) * 18, abs=1e-3)
    assert not joints[0].velocity and not joints[0].effort
    assert imus[0].header.frame_id == names.IMU_FRAME
    assert imus[0].angular_velocity.y == pytest.approx(0.2)
    assert imus[0].orientation.w == 1.0 and imus[0].orientation_covariance[0] > 0
    assert tuple(feet[0].name) == names.LEGS
    assert list(feet[0].contact) == [True, False, True, False, True, False] and not feet[0].force
    assert not tracker
    assert {t for t, _ in peer.node.get_topic_names_and_types()} >= {f"/{names.DIAGNOSTICS}"}
    assert f"/{names.TRACKER_POSE}" not in {
        t for t, _ in peer.node.get_publisher_names_and_types_by_node("driver_node", "/")
    }


def test_an_episode_reset_command_silence_stop_and_release(make_bench, start_graph, peer):
    bench = make_bench(position=0.3)
    start_graph(_node(bench))
    joints = peer.collect(names.JOINT_STATES, JointState, STREAM_QOS)
    scenario: dict = {"task": "balance", "slope_pitch": 0.1, "blocks": [Block()]}
    answer = peer.reset(**scenario)
    assert answer.source == "driver"
    assert "slope" in answer.message and "1 block" in answer.message
    assert seconds(answer.stamp) == pytest.approx(seconds(joints[-1].header.stamp), abs=2.0)
    assert bench.body.position == pytest.approx(np.zeros(18), abs=1e-3)
    assert bench.body.torque.all()

    commands = peer.publisher(names.JOINT_COMMANDS, JointTrajectory, STREAM_QOS)
    target = np.linspace(-0.2, 0.2, 18)
    commands.publish(joint_command(_now(peer), target))
    peer.wait_until(lambda: np.allclose(bench.body.position, target, atol=1e-3), "the target")
    peer.wait_until(lambda: not bench.body.torque.any(), "limp after silence")

    def armed() -> bool:
        commands.publish(joint_command(_now(peer), target))  # again, should a busy machine have made one stale
        return bench.body.armings >= 2

    peer.wait_until(armed, "armed by a command")
    stopped = peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger)
    assert (stopped.success, stopped.message) == (True, "all 18 servos confirm that their torque is off")
    assert not bench.body.torque.any()
    refused = peer.call(names.RESET_EPISODE, ResetEpisode.Request(**scenario), ResetEpisode)
    assert not refused.success and "emergency_stop/release" in refused.message
    assert peer.call(names.RELEASE_EMERGENCY_STOP, Trigger.Request(), Trigger).success
    peer.reset(**scenario)


def test_bad_commands_and_resets_are_refused_and_counted(make_bench, start_graph, peer):
    bench = make_bench()
    start_graph(_node(bench))
    diagnostics = peer.collect(names.DIAGNOSTICS, DiagnosticArray, STREAM_QOS)
    commands = peer.publisher(names.JOINT_COMMANDS, JointTrajectory, STREAM_QOS)
    now = _now(peer)
    old = Time(sec=now.sec - 5, nanosec=now.nanosec)
    wrong = [
        joint_command(now, (float("nan"), *ZERO[1:])),
        joint_command(now, ZERO[:-1], names=names.JOINTS[:-1]),
        joint_command(now, ZERO, names=("tail", *names.JOINTS[1:])),
        joint_command(old, ZERO),
        joint_command(now, ZERO, duration_s=60.0),
        JointTrajectory(joint_names=list(names.JOINTS)),
    ]
    for message in wrong:
        commands.publish(message)

    def refused() -> int:
        values = {v.key: v.value for m in diagnostics[-1:] for s in m.status for v in s.values}
        return int(values.get("refused_commands", 0))

    peer.wait_until(lambda: refused() == len(wrong), "all refusals in diagnostics")
    assert not bench.body.torque.any()
    for position in ([0.0] * 5, [1.0] * 18, [float("nan")] * 18):
        answer = peer.call(names.RESET_EPISODE, ResetEpisode.Request(joint_position=position), ResetEpisode)
        assert not answer.success
        assert "joint_position" in answer.message or "finite" in answer.message


def test_diagnostics_tell_voltage_temperature_link_and_mode(make_bench, start_graph, peer):
    bench = make_bench()
    start_graph(_node(bench))
    diagnostics = peer.collect(names.DIAGNOSTICS, DiagnosticArray, STREAM_QOS)

    def entries() -> dict[str, tuple[int, str, dict[str, str]]]:
        found = diagnostics[-1].status if diagnostics else []
        return {s.name.split(": ")[1]: (s.level[0], s.message, {v.key: v.value for v in s.values}) for s in found}

    peer.wait_until(lambda: "voltage_V" in entries().get("servos", (0, "", {}))[2], "the voltage")
    _, _, servos = entries()["servos"]
    assert servos["voltage_V"] == "7.4" and servos["temperature_C/rr_tibia"] == "31"
    level, message, link = entries()["link"]
    assert (level, message) == (0, "connected")
    assert {"dropped_frames", "damaged_frames", "late_replies"} <= set(link)
    assert entries()["safety"][2]["mode"] == "limp"
    assert entries()["graph"][:2] == (0, "alone")
    intruder = peer.publisher(names.JOINT_STATES, JointState, STREAM_QOS, subscribers=0)
    peer.wait_until(lambda: entries()["graph"][0] == 2, "the second publisher")
    assert "2 publishers on joint_states" in entries()["graph"][1]
    peer.node.destroy_publisher(intruder)
    bench.electronics.bus.absent.add(5)
    peer.wait_until(lambda: entries()["servos"][0] == 2, "the silent servo")
    assert "lm_femur (id 5)" in entries()["servos"][1]
    bench.unplug()
    peer.wait_until(lambda: entries()["link"][0] == 2, "the lost link")
    bench.electronics.bus.absent.clear()
    bench.plug_in()
    peer.wait_until(lambda: entries()["link"][0] == 0, "the link again")
    assert entries()["safety"][0] == 1 and "reset_episode" in entries()["safety"][1]


BAD_STARTS: dict[str, tuple[dict, str]] = {
    "absent": ({"port": "/dev/no_such_robot"}, "/dev/no_such_robot does not exist"),
    "unnamed": ({"port": ""}, "parameter 'port'"),
    "no_port": ({"port": "/dev/null"}, "not a serial port"),
    "too_fast": ({"port": "x", "max_speed": 99.0}, "parameter 'max_speed': got 99.0"),
    "unknown": ({"port": "x", "wheel": 1}, "unknown parameter 'wheel'"),
    "calibration": ({"port": "x", "calibration": "/no/file.toml"}, "calibration /no/file.toml"),
    "clock": ({"port": "x", "use_sim_time": True}, "use_sim_time"),
}


def test_what_cannot_work_ends_with_one_line_and_status_1(start_graph):
    processes = [
        NodeProcess("hexapod_driver", "driver_node", name=name, parameters=parameters)
        for name, (parameters, _) in BAD_STARTS.items()
    ]
    graph = start_graph(*processes, wait=False)
    for name, (_, words) in BAD_STARTS.items():
        assert graph.wait_for_exit(name, DEADLINE_S) == 1, name
        lines = [line for line in graph.tail(name, 20).splitlines() if line.startswith("driver_node:")]
        assert len(lines) == 1 and words in lines[0], graph.tail(name, 20)
        assert "Traceback" not in graph.tail(name, 20)


def test_a_second_driver_on_the_same_port_is_told_that_it_is_busy(make_bench, start_graph, peer):
    bench = make_bench()
    start_graph(_node(bench))
    second = NodeProcess("hexapod_driver", "driver_node", name="second", parameters={"port": bench.paths[0]})
    graph = start_graph(second, wait=False)
    assert graph.wait_for_exit("second", DEADLINE_S) == 1
    assert "busy" in graph.tail("second", 20)


def test_ending_the_node_makes_the_robot_limp(make_bench, start_graph, peer):
    bench = make_bench()
    graph = start_graph(_node(bench))
    peer.reset()
    assert bench.body.torque.all()
    assert graph.stop("driver_node") == {"driver_node": 0}
    assert not bench.body.torque.any()


def test_a_driver_killed_at_once_leaves_a_limp_robot(make_bench, start_graph, peer, until):
    bench = make_bench()
    graph = start_graph(_node(bench))
    peer.reset()
    assert bench.body.torque.all()
    (status,) = graph.status()
    os.kill(status.pid, signal.SIGKILL)
    assert graph.wait_for_exit("driver_node", DEADLINE_S) == -signal.SIGKILL
    until(lambda: not bench.body.torque.any(), "limp by the board's watchdog")


def test_a_driver_started_again_after_a_crash_obeys_no_command_before_a_reset(make_bench, start_graph, peer):
    bench = make_bench()
    graph = start_graph(dataclasses.replace(_node(bench), after_crash=AFTER_CRASH), restart=True)
    commands = peer.publisher(names.JOINT_COMMANDS, JointTrajectory, STREAM_QOS)
    assert peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger).success
    os.kill(graph.status()[0].pid, signal.SIGKILL)
    peer.wait_until(lambda: graph.status()[0].restarts == 1, "the driver's second start")
    diagnostics = peer.collect(names.DIAGNOSTICS, DiagnosticArray, STREAM_QOS)

    def refused() -> bool:
        commands.publish(joint_command(_now(peer), ZERO))
        said = {v.key: v.value for m in diagnostics[-1:] for s in m.status for v in s.values}
        return said.get("needs_reset") == "true" and "reset_episode" in said.get("last_refusal", "")

    peer.wait_until(refused, "a refusal")
    assert not bench.body.armings
    peer.reset()
    assert bench.body.torque.all()
