"""The policy node in a running graph."""

import dataclasses
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import LoadPolicy
from tcbi_policy import policy_node as policy_node_module
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.gaits import Gait
from tcbi_policy.policy_node import PolicyNode
from tests.policy_cases import own_process, policy_node, wait_until

__all__ = ["own_process"]  # the fixture

pytestmark = pytest.mark.graph
MS = 1_000_000


def nanoseconds(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def begin_rollout(peer: Any, task: str, duration: float, seed: int = 1) -> int:
    """Reset, BEGIN, policy on; the rollout's zero in ns."""
    reset = peer.reset(task=task, duration=duration, seed=seed)
    event = RolloutEvent(rollout_id="r", kind=RolloutEvent.BEGIN, task=task)
    event.header.stamp = reset.stamp
    peer.publisher(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS, subscribers=2).publish(event)
    assert peer.call(names.ENABLE_POLICY, SetBool.Request(data=True), SetBool).success
    return nanoseconds(event)


class Sensors:
    """Sensor data made by the test, at stamps of its choice."""

    def __init__(self, peer: Any) -> None:
        self.joints = peer.publisher(names.JOINT_STATES, JointState, messages.STREAM_QOS)
        self.imu = peer.publisher(names.IMU, Imu, messages.STREAM_QOS)
        self.stamp = time.time_ns() // (20 * MS) * (20 * MS)

    def send(self, count: int, imu: bool = True) -> None:
        for _ in range(count):
            self.stamp += 20 * MS
            stamp = messages.to_stamp(self.stamp)
            if imu:
                self.imu.publish(messages.imu(stamp, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0, 0.0, 9.81)))
            self.joints.publish(messages.joint_state(stamp, [0.0] * 18))


def test_in_lockstep_every_tick_of_a_rollout_has_its_command_also_while_policies_are_swapped(
    start_graph: Any, peer: Any, tmp_path: Any
) -> None:
    sim = NodeProcess("tcbi_sim", "sim_node", parameters={"mode": "lockstep", "timestep": 0.01, "store": str(tmp_path)})
    start_graph(sim, policy_node(policy="gait:tripod", use_sim_time=True, store=str(tmp_path)))
    commands = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS, publishers=1)
    status = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    zero = begin_rollout(peer, "forward", 30.0)
    peer.wait_until(lambda: len(commands) >= 20, "twenty commands")
    loaded = [peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy=p), LoadPolicy) for p in ("balance", "gait:stand")]
    assert all(answer.success for answer in loaded)
    peer.wait_until(lambda: len(commands) >= 150, "all commands of the rollout")
    stamps = [nanoseconds(c) for c in commands[:150]]
    assert stamps == [zero + k * 200 * MS for k in range(150)]
    assert commands[0].joint_names == list(names.JOINTS)
    first = np.array([c.points[0].positions for c in commands[:20]])
    np.testing.assert_allclose(first, Gait("tripod").targets[:20], atol=1e-12)
    np.testing.assert_array_equal(commands[149].points[0].positions, np.zeros(18))
    assert [m.data.partition("@")[0] for m in status] == ["gait:tripod", "balance", "gait:stand"]


def test_in_real_time_no_tick_is_missed_while_policies_are_swapped(start_graph: Any, peer: Any, tmp_path: Any) -> None:
    sim = NodeProcess("tcbi_sim", "sim_node", parameters={"store": str(tmp_path)})
    start_graph(sim, policy_node(policy="gait:tripod", store=str(tmp_path)))
    commands = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS, publishers=1)
    seen = []

    def come(count: int) -> bool:
        wanted = len(commands) + count
        return peer.comes(lambda: len(commands) >= wanted, 10.0)

    for _ in range(5):  # a busy machine may hold up the sensors: then a tick is missed, or all stops
        began = len(commands)
        begin_rollout(peer, "balance", 60.0)
        came = come(1)
        for policy in ("balance", "gait:stand", "balance-early", "gait:tripod"):
            assert peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy=policy), LoadPolicy).success
            came = came and come(2)
        seen.append(np.diff([nanoseconds(c) for c in commands[began:]]) / MS)
        if came and (seen[-1] == 200).all():
            return
    pytest.fail(f"gaps between commands, in ms: {seen}")


def test_the_same_stamps_give_the_same_commands_whenever_they_arrive(start_graph: Any, peer: Any) -> None:
    start_graph(policy_node(policy="balance"))
    commands = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
    sensors = Sensors(peer)
    assert peer.call(names.ENABLE_POLICY, SetBool.Request(data=True), SetBool).success
    for number in range(5):
        sensors.send(10)
        peer.wait_until(lambda least=number: len(commands) > least, "a command")
    stamps = [nanoseconds(c) for c in commands]
    assert all(b - a == 200 * MS for a, b in pairwise(stamps))
    assert all(stamp % (200 * MS) == 0 for stamp in stamps)
    assert np.ptp([c.points[0].positions for c in commands], axis=0).max() == 0.0


def test_a_lost_imu_stops_the_motion_says_so_and_waits_for_the_next_enable(start_graph: Any, peer: Any) -> None:
    start_graph(policy_node(policy="balance"))
    commands = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
    diagnostics = peer.collect(names.DIAGNOSTICS, DiagnosticArray, messages.STREAM_QOS)
    sensors = Sensors(peer)
    peer.call(names.ENABLE_POLICY, SetBool.Request(data=True), SetBool)
    sensors.send(15)
    peer.wait_until(lambda: len(commands) >= 1, "a command")

    def said() -> list[str]:
        return [s.message for d in diagnostics for s in d.status if s.name == "policy_node" and s.level == b"\x02"]

    sensors.send(40, imu=False)
    peer.wait_until(lambda: bool(said()), "an error in the diagnostics")
    assert "imu/data" in said()[0]
    count = len(commands)
    sensors.send(30)
    peer.call(names.LOAD_POLICY, LoadPolicy.Request(), LoadPolicy)
    assert len(commands) == count
    peer.call(names.ENABLE_POLICY, SetBool.Request(data=True), SetBool)
    sensors.send(15)
    peer.wait_until(lambda: len(commands) > count, "a command after the next enable")


def test_a_policy_that_does_not_exist_leaves_the_present_one(start_graph: Any, peer: Any) -> None:
    start_graph(policy_node(policy="gait:stand"))
    answer = peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy="gait:moonwalk"), LoadPolicy)
    assert not answer.success
    assert "tripod" in answer.message
    assert answer.policy_id == "gait:stand"


def test_a_policy_that_cannot_be_loaded_leaves_the_present_one_and_the_next_is_loaded(
    start_graph: Any, peer: Any, tmp_path: Any
) -> None:
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    layout = dataclasses.replace(shipped.card.layout, limit=None)  # type: ignore[arg-type]
    outside = dataclasses.replace(shipped.card, name="../../outside")
    cards = {"typeless": dataclasses.replace(shipped.card, layout=layout), "escaping": outside}
    paths = [f"{tmp_path}/{name}.safetensors" for name in cards]
    mlp = dataclasses.replace(shipped.mlp, weights=tuple(w / 2 for w in shipped.mlp.weights))  # not in the store yet
    for path, card in zip(paths, cards.values(), strict=True):
        save_policy(Path(path).with_suffix(""), mlp, card)
    start_graph(policy_node(policy="gait:stand", store=str(tmp_path / "store")))
    for path in (*paths, "~nouser/x.safetensors"):
        answer = peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy=path), LoadPolicy, 20.0)
        assert not answer.success and path in answer.message
        assert answer.policy_id == "gait:stand"
    assert not list(tmp_path.rglob("outside*"))
    assert peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy="balance"), LoadPolicy).success


def test_whatever_goes_wrong_in_reading_a_policy_is_told_to_whoever_awaits_it(
    own_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = PolicyNode()

    def broken(*_: object) -> None:
        raise ZeroDivisionError("by accident")

    monkeypatch.setattr(policy_node_module, "find_policy", broken)
    future = node._read("mine")
    wait_until(future.done)
    assert isinstance(future.exception(), TcbiError)
    assert str(future.exception()) == "policy mine: ZeroDivisionError: by accident"
    node.destroy_node()


def test_a_node_with_an_unknown_policy_ends_with_one_line(start_graph: Any) -> None:
    graph = start_graph(policy_node(policy="moonwalk"), wait=False)
    assert graph.wait_for_exit("policy_node", 40.0) == 1
    assert "moonwalk" in graph.tail("policy_node", 1)


def test_a_policy_that_lends_the_robot_gets_it_back_or_its_successor_does(start_graph: Any, peer: Any) -> None:
    start_graph(policy_node(policy="gait:stand"))
    in_use = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(in_use), "the policy in use")

    def ask(**request: Any) -> tuple[bool, str, str]:
        answer = peer.call(names.LOAD_POLICY, LoadPolicy.Request(**request), LoadPolicy)
        return answer.success, answer.policy_id, answer.lender

    early, balance = (find_policy(name).policy_id for name in ("balance-early", "balance"))
    assert ask(policy="gait:steps", lend=True) == (True, "gait:steps", "gait:stand")
    assert ask(policy="gait:squat", lend=True) == (True, "gait:squat", "gait:stand"), "who lends stays the same"
    assert ask(policy="balance", replaces="gait:squat") == (False, "gait:squat", "gait:stand"), "it is not its place"
    assert ask(policy="balance-early", replaces="gait:stand") == (True, "gait:squat", early)
    assert ask() == (True, "gait:squat", early)
    assert ask(policy="balance", replaces="gait:stand") == (False, "gait:squat", early)
    assert ask(give_back=True) == ask(give_back=True) == (True, early, "")
    assert ask(policy="balance", replaces=early) == (True, balance, "")
    assert ask(policy="gait:steps", lend=True) == (True, "gait:steps", balance)
    assert ask(policy="gait:tripod") == (True, "gait:tripod", ""), "whoever loads a policy ends the loan"
    assert ask(give_back=True) == (True, "gait:tripod", "")
    told = ["gait:stand", "gait:steps", "gait:squat", early, balance, "gait:steps", "gait:tripod"]
    peer.wait_until(lambda: len(in_use) >= len(told), "every policy in use")
    assert [message.data for message in in_use] == told
