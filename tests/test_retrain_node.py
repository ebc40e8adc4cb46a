"""The retrain action in a running graph, and its node by itself."""

import time
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_msgs.action import Retrain
from tcbi_msgs.srv import LoadPolicy
from tcbi_policy import retrain_node as retrain_node_module
from tcbi_policy.artefact import find_policy
from tcbi_policy.retrain_node import RetrainNode
from tcbi_policy.retraining import Outcome
from tests.policy_cases import own_process, policy_node, wait_until

__all__ = ["own_process"]  # the fixture

pytestmark = pytest.mark.graph


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
    result = Retrain.Result()
    outcome = Outcome(True, False, "balance-1", "/balance-1.safetensors", 1.0, 2.0, "better", "gait:stand")
    node._finish(handle, result, outcome, "balance", "gait:stand")
    node.destroy_node()
    assert not asked and ends == ["succeed"] and result.accepted
    assert result.message == "better; kept as balance-1, not loaded: cancelled after the comparison"


def test_who_cancels_does_not_wait_for_a_policy_node_that_hangs(
    own_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrain_node_module, "TrainingProcess", lambda: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(retrain_node_module, "SWAP_PATIENCE_S", 60.0)
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
    node._finish(handle, result, outcome, "balance", "gait:stand")
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
    found = node._in_use_now(SimpleNamespace(is_cancel_requested=False))
    current = node._job(Retrain.Goal(task="balance"), found).current
    node.destroy_node()
    assert current == rival


def test_a_policy_for_another_task_is_no_rival_and_stays_in_use(
    own_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrain_node_module, "TrainingProcess", lambda: SimpleNamespace(close=lambda: None))
    node: Any = RetrainNode()
    walks, asked = find_policy("forward").policy_id, []
    node._load = SimpleNamespace(service_is_ready=lambda: True, call_async=asked.append)
    job, result = node._job(Retrain.Goal(task="balance"), walks), Retrain.Result()
    handle: Any = SimpleNamespace(is_cancel_requested=False, succeed=lambda: None)
    rival = find_policy("balance").policy_id
    outcome = Outcome(True, False, "balance-1", "/balance-1.safetensors", 1.0, 2.0, "better", rival)
    node._finish(handle, result, outcome, "balance", walks)
    node.destroy_node()
    assert job.current == "balance" and not asked
    assert result.message == f"better; kept as balance-1: {walks}, which is in use, is no policy for balance"


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
