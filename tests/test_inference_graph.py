"""The inference node in a graph: from finished bags to posterior, error, training, new effects and a diagnosis."""

import dataclasses
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from rclpy.action import ActionClient, ActionServer, GoalResponse

from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_contract import messages, names
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurements
from tcbi_msgs.action import Diagnose, Retrain
from tcbi_msgs.msg import ModelError, Posterior
from tcbi_msgs.srv import AddEffect, LoadModel
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore

pytestmark = pytest.mark.graph

RIG = "servo_bench"
WORK_S = 90.0  # for a worker process on a busy machine


def write_rollouts(folder: Path, first: int, count: int, source: str = "sim") -> list[str]:
    """Bags of a servo bench whose gain is half the nominal one."""
    model, times = base_model(RIG), np.arange(0.0, 2.0, 0.4)
    truth = np.array([[p.nominal for p in model.parameters]]) * [0.5, 1.0, 1.0]
    ids = []
    for i in range(first, first + count):
        rng = np.random.default_rng(i)
        commands = Commands(times, rng.uniform(-1, 1, (len(times), 1)))
        rollouts = simulate(model, truth, [Scenario("steps", 2.0, seed=i)], commands=[commands], timestep=0.005)
        measured = rollouts.measurement(0, 0, f"steps_{i}")  # by no policy that acts on what it sees
        measured = dataclasses.replace(measured, source=source)
        write_measurement(folder, measured)
        ids.append(measured.rollout_id)
    return ids


def cut_off(bag: Path) -> None:
    """As a full disk left it a minute ago: no metadata, no index."""
    (bag / "metadata.yaml").unlink()
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    then = time.time() - 60.0
    for path in (file, bag):
        os.utime(path, (then, then))


def inferring(graph: Graph) -> list[psutil.Process]:
    """The workers of the only node."""
    (status,) = graph.status()
    family = psutil.Process(status.pid).children(recursive=True)
    return [p for p in family if "tcbi_infer.inference_worker" in p.cmdline()]


@pytest.fixture
def node(tmp_path: Path) -> NodeProcess:
    values = {
        "store": str(tmp_path / "store"),
        "bags": str(tmp_path / "bags"),
        "model": f"{RIG}-v0",
        "particles": 20,
        "generations": 2,
        "least_rollouts": 4,
        "new_rollouts": 2,
        "holdout_every": 3,
        "posterior_moved": 0.2,
        "poll_s": 0.2,
    }
    return NodeProcess("tcbi_infer", "inference_node", parameters=values)


def test_finished_rollouts_become_a_posterior_an_error_and_a_training(start_graph, peer, node, tmp_path):
    goals, refused = [], []

    def answer(goal):
        refused.append(goal)
        return GoalResponse.REJECT if len(refused) == 1 else GoalResponse.ACCEPT

    def train(handle):
        goals.append(handle.request)
        handle.succeed()
        return Retrain.Result(success=True, message="trained")

    ids = write_rollouts(tmp_path / "bags", 0, 6)
    cut_off(tmp_path / "bags" / ids[0])
    graph = start_graph(node)
    posteriors = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    running = peer.collect(names.POSTERIOR_PROGRESS, Posterior, messages.STREAM_QOS)
    errors = peer.collect(names.MODEL_ERROR, ModelError, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(posteriors and errors), "posterior and error", WORK_S)
    # a server that comes late and is busy at first gets the wish all the same
    server = ActionServer(peer.node, Retrain, names.RETRAIN, train, goal_callback=answer)
    peer.wait_until(lambda: bool(goals), "training", WORK_S)
    assert len(refused) == 2

    first = posteriors[0]
    assert (first.rig, first.model, first.task) == (RIG, f"{RIG}-v1", "steps")
    assert list(first.parameter) == ["gain", "damping", "friction"]
    assert len(first.particles) == 3 * len(first.weights)
    assert sum(first.weights) == pytest.approx(1.0)
    assert len(first.source_rollouts) == 4
    assert not set(first.source_rollouts) & set(errors[-1].rollouts), "a rollout was fitted and judged"
    assert len(errors[-1].rollouts) == 2 and errors[-1].error_over_floor > 0
    assert not {s.unit for s in errors[-1].signals} & {"deg", "deg/s"}, "topics speak the SI"
    assert (goals[0].task, goals[0].model) == ("steps", f"{RIG}-v1")
    assert f"{RIG}-v1" in ModelStore(tmp_path / "store").versions(RIG)

    write_rollouts(tmp_path / "bags", 6, 3)
    peer.wait_until(lambda: posteriors[-1].model == f"{RIG}-v2", "the second posterior", WORK_S)
    assert len(posteriors[-1].source_rollouts) == 6
    # of the first inference they may be missed: nothing is kept for who listens later
    assert running and {m.generation for m in running} == {1}
    assert not any(m.converged or len(m.particles) for m in running)
    assert ids[0] in first.source_rollouts and ids[0] in posteriors[-1].source_rollouts
    damaged = [line for line in graph.tail("inference_node", 1000).splitlines() if "is damaged" in line]
    assert len(damaged) == 1 and ids[0] in damaged[0], "each bag's damage is said once, not at each inference"
    server.destroy()


def test_an_inference_whose_worker_is_killed_is_made_again(start_graph, peer, node, tmp_path):
    graph = start_graph(node)
    posteriors = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    write_rollouts(tmp_path / "bags", 0, 6)  # no earlier: the inference takes less time than the start
    peer.wait_until(lambda: bool(inferring(graph)), "the worker", WORK_S)
    inferring(graph)[0].kill()
    peer.wait_until(lambda: bool(posteriors), "the posterior of the second try", WORK_S)
    assert "it is tried again in 5 s" in graph.tail("inference_node", 1000)


def test_an_error_that_fell_is_reason_enough_for_a_training(start_graph, peer, node, tmp_path):
    goals = []

    def train(handle):
        goals.append(handle.request)
        handle.succeed()
        return Retrain.Result(success=True, message="trained")

    write_rollouts(tmp_path / "bags", 0, 6)
    server = ActionServer(peer.node, Retrain, names.RETRAIN, train)
    still = {"posterior_moved": 1e9, "error_fell": 0.3}
    graph = start_graph(NodeProcess("tcbi_infer", "inference_node", parameters={**node.parameters, **still}))
    errors = peer.collect(names.MODEL_ERROR, ModelError, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(goals), "training", WORK_S)
    peer.wait_until(lambda: bool(errors) and errors[-1].model == f"{RIG}-v1", "the new version's error")
    (why,) = [line for line in graph.tail("inference_node", 1000).splitlines() if "wants a training" in line]
    assert "the error on held-out rollouts fell by" in why and "moved" not in why
    server.destroy()


def test_the_rollouts_of_a_simulation_are_no_rollouts_of_the_robot(start_graph, peer, node, tmp_path):
    write_rollouts(tmp_path / "bags", 0, 6)
    own = write_rollouts(tmp_path / "bags", 6, 4, source="driver")
    every = {**node.parameters, "holdout_every": 0, "retrain": False}
    graph = start_graph(NodeProcess("tcbi_infer", "inference_node", parameters=every))
    posteriors = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(posteriors), "the posterior", WORK_S)
    assert set(posteriors[0].source_rollouts) == set(own)
    (said,) = [line for line in graph.tail("inference_node", 1000).splitlines() if "whose source" in line]
    assert "6 rollouts whose source is sim" in said and "newest one is driver" in said


def test_a_node_that_is_started_again_publishes_its_posterior_and_infers_nothing_anew(
    start_graph, peer, node, tmp_path
):
    write_rollouts(tmp_path / "bags", 0, 6)
    quiet = NodeProcess("tcbi_infer", "inference_node", parameters={**node.parameters, "retrain": False})
    graph = start_graph(quiet)
    before = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(before), "the posterior", WORK_S)
    peer.wait_until(lambda: "inferring" in graph.tail("inference_node", 1000), "its line")
    graph.stop()
    graph = start_graph(quiet)
    after = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(after), "the posterior, once more", WORK_S)
    assert (after[-1].model, after[-1].source_rollouts) == (f"{RIG}-v1", before[0].source_rollouts)
    assert list(after[-1].mean) == list(before[0].mean)
    assert not peer.comes(lambda: "inferring" in graph.tail("inference_node", 1000), 2.0)
    write_rollouts(tmp_path / "bags", 6, 3)
    peer.wait_until(lambda: after[-1].model == f"{RIG}-v2", "the posterior of all of them", WORK_S)


def test_a_training_whose_server_dies_is_asked_for_again(start_graph, peer, node, tmp_path):
    goals = []

    def answer(goal):
        goals.append(goal)
        return GoalResponse.ACCEPT

    def train(handle):
        handle.succeed()
        return Retrain.Result(success=True, message="trained")

    def server(accepted):
        return ActionServer(
            peer.node, Retrain, names.RETRAIN, train, goal_callback=answer, handle_accepted_callback=accepted
        )

    def said(words):
        return words in graph.tail("inference_node", 1000)

    write_rollouts(tmp_path / "bags", 0, 6)
    first = server(lambda handle: None)  # accepts, and is never heard of again
    graph = start_graph(node)
    peer.wait_until(lambda: len(goals) == 1, "the first goal", WORK_S)
    peer.comes(lambda: False, 1.0)
    first.destroy()
    second = server(lambda handle: None)  # so soon that no absence is seen
    peer.wait_until(lambda: len(goals) == 2, "the goal, once more")
    assert said(f"knows no training on {RIG}-v1")
    second.destroy()
    peer.wait_until(lambda: said("the retrain server has gone"), "the absence")
    third = server(lambda handle: handle.execute())
    peer.wait_until(lambda: said(f"training on {RIG}-v1: trained"), "the end of the training")
    assert len(goals) == 3 and goals[0] == goals[1] == goals[2]
    third.destroy()


def test_effects_are_added_and_models_loaded_by_service(start_graph, peer, node, tmp_path):
    start_graph(node)
    added = peer.call(names.ADD_EFFECT, AddEffect.Request(effect="command_latency"), AddEffect)
    assert added.success and added.model == f"{RIG}-v1", added.message
    assert ModelStore(tmp_path / "store").load(added.model).effects == ("command_latency",)
    assert "as wide as the prior" in added.message
    refused = peer.call(names.ADD_EFFECT, AddEffect.Request(effect="command_latncy"), AddEffect)
    assert not refused.success and "did you mean 'command_latency'" in refused.message
    loaded = peer.call(names.INFERENCE_LOAD_MODEL, LoadModel.Request(model=f"{RIG}-v0"), LoadModel)
    assert loaded.success and loaded.model == f"{RIG}-v0"
    missing = peer.call(names.INFERENCE_LOAD_MODEL, LoadModel.Request(model=f"{RIG}-v9"), LoadModel)
    assert not missing.success and "unknown model version" in missing.message


def test_the_newest_version_is_that_of_the_rig_that_was_recorded(start_graph, peer, node, tmp_path):
    write_rollouts(tmp_path / "bags", 0, 1)
    quiet = {**node.parameters, "model": "latest", "least_rollouts": 100}
    start_graph(NodeProcess("tcbi_infer", "inference_node", parameters=quiet))
    added = peer.call(names.ADD_EFFECT, AddEffect.Request(effect="command_latency"), AddEffect)
    assert added.success and added.model == f"{RIG}-v1", added.message
    loaded = peer.call(names.INFERENCE_LOAD_MODEL, LoadModel.Request(), LoadModel)
    assert loaded.success and loaded.model == f"{RIG}-v1"


def test_rollouts_of_a_rig_that_has_no_model_are_told_and_end_nothing(start_graph, peer, node, tmp_path):
    measured = read_measurements([tmp_path / "bags" / name for name in write_rollouts(tmp_path / "bags", 0, 1)])[0]
    foreign = dataclasses.replace(measured, rig="nobodys", rollout_id="foreign")
    shutil.rmtree(tmp_path / "bags")
    write_measurement(tmp_path / "bags", foreign)
    graph = start_graph(NodeProcess("tcbi_infer", "inference_node", parameters={**node.parameters, "model": "latest"}))
    refused = peer.call(names.ADD_EFFECT, AddEffect.Request(effect="command_latency"), AddEffect)
    assert not refused.success and "the rig 'nobodys' has no model" in refused.message
    assert "the rig 'nobodys' has no model" in graph.tail("inference_node", 1000)


def test_an_effect_that_is_added_during_an_inference_is_in_the_next_one(start_graph, peer, node, tmp_path):
    graph = start_graph(node)
    posteriors = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    write_rollouts(tmp_path / "bags", 0, 6)  # no earlier: the inference takes less time than the start
    peer.wait_until(lambda: bool(inferring(graph)), "the inference", WORK_S)
    added = peer.call(names.ADD_EFFECT, AddEffect.Request(effect="command_latency"), AddEffect)
    assert added.success and added.model == f"{RIG}-v1", added.message
    peer.wait_until(lambda: bool(posteriors), "the posterior", WORK_S)
    assert "command_latency.delay" in posteriors[0].parameter and posteriors[0].model == f"{RIG}-v2"
    assert "is given up" in graph.tail("inference_node", 1000)


def test_a_diagnosis_is_an_action_with_feedback(start_graph, peer, node, tmp_path):
    ids = write_rollouts(tmp_path / "bags", 0, 3)
    quiet = NodeProcess("tcbi_infer", "inference_node", parameters={**node.parameters, "least_rollouts": 100})
    start_graph(quiet)
    client, heard = ActionClient(peer.node, Diagnose, names.DIAGNOSE), []
    goal = Diagnose.Goal(bags=[str(tmp_path / "bags" / name) for name in ids], model=f"{RIG}-v0")
    sent = peer.send(client, Diagnose, goal, heard.append)
    assert sent.taken
    result = peer.end(sent, "the diagnosis", 2 * WORK_S).result
    assert result.success, result.message
    assert result.diagnosis.model == f"{RIG}-v0" and result.diagnosis.statement == result.message
    fractions = [message.feedback.fraction for message in heard]
    assert len(fractions) > 3 and fractions == sorted(fractions)
    assert any(message.feedback.remaining_s > 0 for message in heard)
    client.destroy()
    fitted = result.diagnosis.ranking[0].effect  # the best candidates get a full fit
    added = peer.call(names.ADD_EFFECT, AddEffect.Request(effect=fitted, model=f"{RIG}-v0"), AddEffect)
    assert added.success and "as the newest diagnosis fitted it" in added.message, added.message
    assert ModelStore(tmp_path / "store").load(added.model).evidence["kind"] == "diagnosis"
    (path,) = (tmp_path / "store" / "runs").glob("diagnosis-*.json")
    found = json.loads(path.read_text())
    found["agreement"][fitted][-1] |= {"agrees": False, "statement": "The motions disagree on it."}
    path.write_text(json.dumps(found))
    refused = peer.call(names.ADD_EFFECT, AddEffect.Request(effect=fitted, model=f"{RIG}-v0"), AddEffect)
    assert not refused.success and "The motions disagree on it." in refused.message


def test_a_model_that_does_not_exist_ends_the_node_with_one_line(start_graph, node):
    wrong = NodeProcess("tcbi_infer", "inference_node", parameters={**node.parameters, "model": "hexapod-v99"})
    graph = start_graph(wrong, wait=False)
    assert graph.wait_for_exit("inference_node", 30.0) == 1
    assert "unknown model version 'hexapod-v99'" in graph.tail("inference_node", 5)
