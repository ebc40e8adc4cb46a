"""The policy node and the retrain action in a running graph."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_msgs.action import Retrain
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import LoadPolicy
from tcbi_policy import policy_node as policy_node_module
from tcbi_policy import retrain_node as retrain_node_module
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.gaits import Gait
from tcbi_policy.policy_node import PolicyNode
from tcbi_policy.retrain_node import RetrainNode
from tcbi_policy.retraining import Job, Outcome
from tests.conftest import ros_in_process

pytestmark = pytest.mark.graph
MS = 1_000_000


def wait_until(holds: Callable[[], bool], meanwhile: Callable[[], object] = lambda: time.sleep(0.01)) -> None:
    deadline = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < deadline, "did not come to hold within 20 s"
        meanwhile()


def nanoseconds(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def policy_node(**parameters: Any) -> NodeProcess:
    return NodeProcess("tcbi_policy", "policy_node", parameters=parameters)


@pytest.fixture
def own_process(domain: int, tmp_path: Any) -> Iterator[None]:
    """For a node in the process of the test, which replaces a part of it."""
    with ros_in_process(["--ros-args", "-p", f"store:={tmp_path / 'store'}"]):
        yield


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


def test_a_process_that_cannot_stand_by_is_tried_again_later_and_told_once(
    own_process: None, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    starts: list[float] = []

    def no_memory() -> None:
        starts.append(time.monotonic())
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(retrain_node_module, "TrainingProcess", no_memory)
    monkeypatch.setattr(retrain_node_module, "STAND_BY_AGAIN_S", 1.5)
    node = RetrainNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    wait_until(lambda: len(starts) >= 3, lambda: executor.spin_once(0.1))
    assert all(b - a >= 1.5 for a, b in pairwise(starts))
    node.destroy_node()
    said = capfd.readouterr().err
    assert said.count("no process stands by") == said.count("Cannot allocate memory") == 1


def test_a_training_gets_a_new_process_if_the_one_that_stood_by_has_died(own_process: None) -> None:
    node = RetrainNode()
    stood_by = node._waiting
    assert stood_by is not None
    stood_by.end()
    with node._process() as process:
        assert process is not stood_by and process.running
    node.destroy_node()


def test_a_training_gets_the_process_that_stands_by(own_process: None) -> None:
    node = RetrainNode()
    stood_by = node._waiting
    with node._process() as process:
        assert process is stood_by
    node.destroy_node()


@pytest.mark.parametrize("moment", ["before the swap", "while it waits for the policy node"])
def test_who_cancels_after_the_comparison_gets_no_other_policy_on_the_robot(
    own_process: None, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    monkeypatch.setattr(retrain_node_module, "TrainingProcess", lambda: SimpleNamespace(close=lambda: None))
    node: Any = RetrainNode()
    ends: list[str] = []
    handle: Any = SimpleNamespace(succeed=lambda: ends.append("succeed"))
    handle.is_cancel_requested = moment == "before the swap"

    def appears() -> bool:
        handle.is_cancel_requested = True
        return True

    asked: list[Any] = []
    node._load = SimpleNamespace(service_is_ready=appears, call_async=asked.append)
    result, job = Retrain.Result(), Job("balance", "gait:stand")
    outcome = Outcome(True, False, "balance-1", "/balance-1.safetensors", 1.0, 2.0, "better", "gait:stand")
    node._finish(handle, result, outcome, job)
    node.destroy_node()
    assert not asked and ends == ["succeed"] and result.accepted
    assert result.message == "better; kept as balance-1, not loaded: cancelled after the comparison"


def test_who_cancels_does_not_wait_for_a_policy_node_that_hangs(
    own_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrain_node_module, "TrainingProcess", lambda: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(retrain_node_module, "SWAP_TIMEOUT_S", 60.0)
    node: Any = RetrainNode()
    handle: Any = SimpleNamespace(is_cancel_requested=False, succeed=lambda: None)
    asked: list[Any] = []

    def hangs(request: Any) -> Any:
        asked.append(request)
        handle.is_cancel_requested = True
        return SimpleNamespace(done=lambda: False)

    node._load = SimpleNamespace(service_is_ready=lambda: True, call_async=hangs)
    result = Retrain.Result()
    outcome = Outcome(True, False, "balance-1", "/balance-1.safetensors", 1.0, 2.0, "better", "gait:stand")
    began = time.monotonic()
    node._finish(handle, result, outcome, Job("balance", "gait:stand"))
    took = time.monotonic() - began
    node.destroy_node()
    assert len(asked) == 1 and took < 30.0, "the node's own limit was 60 s"
    assert "cancelled while it was asked to take it" in result.message


@pytest.mark.parametrize(
    ("answer", "in_use", "rival"),
    [
        (LoadPolicy.Response(policy_id="gait:steps", lender="gait:stand"), "gait:steps", "gait:stand"),
        (LoadPolicy.Response(policy_id="gait:steps"), "gait:steps", "gait:steps"),
        (None, "gait:squat", "gait:squat"),
        (None, "", "gait:stand"),
    ],
)
def test_what_a_new_policy_must_beat_is_in_use_or_will_be_after_a_recording(
    own_process: None, monkeypatch: pytest.MonkeyPatch, answer: Any, in_use: str, rival: str
) -> None:
    """Without a policy node it is what was in use last, or the fallback."""
    monkeypatch.setattr(retrain_node_module, "TrainingProcess", lambda: SimpleNamespace(close=lambda: None))
    node: Any = RetrainNode()
    node._on_policy(String(data=in_use))
    future = SimpleNamespace(done=lambda: True, result=lambda: answer)
    node._load = SimpleNamespace(service_is_ready=lambda: answer is not None, call_async=lambda _: future)
    found = node._rival(SimpleNamespace(is_cancel_requested=False))
    current = node._job(Retrain.Goal(task="balance"), found).current
    node.destroy_node()
    assert current == rival


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


@pytest.mark.slow
def test_retraining_is_cancelled_at_once_and_resumed_and_says_whether_the_result_is_better(
    start_graph: Any, peer: Any, tmp_path: Any
) -> None:
    retrain = NodeProcess("tcbi_policy", "retrain_node", parameters={"store": str(tmp_path)})
    start_graph(policy_node(policy="balance", store=str(tmp_path)), retrain)
    client = ActionClient(peer.node, Retrain, names.RETRAIN)
    feedback: list[Any] = []
    goal = Retrain.Goal(task="balance", budget_s=8.0)
    sent = peer.send(client, Retrain, goal, feedback.append)
    assert sent.taken
    peer.wait_until(lambda: bool(feedback), "feedback", 110.0)
    peer.result(sent.handle.cancel_goal_async(), "the answer to the cancellation")
    result = peer.end(sent, "the end of the cancelled goal", 10.0).result
    assert not result.success and "cancelled" in result.message
    sent = peer.send(client, Retrain, goal, feedback.append)
    peer.wait_until(lambda: feedback[-1].feedback.steps > 0, "steps, which its end tells at the latest", 110.0)
    told = feedback[-1].feedback
    assert np.isfinite(told.mean_return) and 0 <= told.remaining_s <= goal.budget_s
    result = peer.end(sent, "the result", 110.0).result
    assert result.success, result.message
    assert result.message.startswith("better" if result.accepted else "not better")
    assert np.isfinite([result.return_before, result.return_after]).all()


def retrained(start_graph: Any, peer: Any, store: Any, in_use: str, start: str) -> tuple[Any, list[String]]:
    """Result of one set of episodes on *balance*, and what was said to be in use meanwhile."""
    node = NodeProcess("tcbi_policy", "retrain_node", parameters={"store": str(store)})
    start_graph(policy_node(policy=in_use, store=str(store)), node)
    status = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(status), "the policy in use")
    client = ActionClient(peer.node, Retrain, names.RETRAIN)
    goal = Retrain.Goal(task="balance", policy=start, budget_steps=1)
    return peer.end(peer.send(client, Retrain, goal), "the result", 300.0).result, status


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_worse_policy_leaves_the_one_in_use(start_graph: Any, peer: Any, tmp_path: Any) -> None:
    """From scratch, against a policy of 160 processor seconds."""
    result, status = retrained(start_graph, peer, tmp_path, "balance", "none")
    assert result.success and not result.accepted, result.message
    assert result.message.startswith("not better with confidence: return")
    assert result.return_after < result.return_before
    assert {heard.data for heard in status} == {find_policy("balance").policy_id}


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_better_policy_is_swapped_in_and_the_policy_node_says_so(start_graph: Any, peer: Any, tmp_path: Any) -> None:
    result, status = retrained(start_graph, peer, tmp_path, "gait:dither", "balance")
    assert result.accepted and result.return_after > result.return_before, result.message
    peer.wait_until(lambda: status[-1].data.startswith("balance-1@"), "the successor in use")
    assert result.message.endswith(f"now in use as {status[-1].data}")
