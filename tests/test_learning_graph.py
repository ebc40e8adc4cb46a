"""All nodes of `./tcbi up` together: rollouts become a posterior, which asks for a training, and that ends well."""

import dataclasses
import re

import pytest
from action_msgs.msg import GoalStatus
from std_msgs.msg import String

from tcbi_bringup.robot_graph import GraphOptions, companion_processes, robot_processes
from tcbi_contract import messages, names
from tcbi_msgs.msg import Posterior
from tcbi_policy.artefact import find_policy
from tests.recording_cases import Collection

pytestmark = [pytest.mark.graph, pytest.mark.timeout(600)]

SMALL = {
    "sim_node": {"lockstep_timeout_s": 60.0},  # a rollout that misses a command of a busy machine is not inferred from
    "inference_node": {
        "particles": 10,
        "generations": 1,
        "least_rollouts": 3,
        "new_rollouts": 3,
        "holdout_every": 0,
        "posterior_moved": 0.0,
        "retrain_budget_s": 3.0,
    },
}
WORK_S = 240.0  # for inference and training on a busy machine


def test_rollouts_become_a_posterior_a_training_and_the_policy_in_use_if_it_is_better(start_graph, peer, tmp_path):
    options = GraphOptions(
        store=tmp_path / "store", policy="balance-early", lockstep=True, recordings=tmp_path / "bags"
    )
    processes = [*robot_processes(options, tmp_path), *companion_processes(options)]
    changed = [dataclasses.replace(p, parameters={**p.parameters, **SMALL.get(p.executable, {})}) for p in processes]
    graph = start_graph(*changed)
    in_use = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    posteriors = peer.collect(names.POSTERIOR, Posterior, messages.LATCHED_QOS)
    status, result = Collection(peer, task="balance", number=3, duration_s=2.0).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    peer.wait_until(lambda: bool(posteriors), "the posterior", WORK_S)
    assert posteriors[-1].task == "balance" and len(posteriors[-1].source_rollouts) == 3

    def ended() -> re.Match[str] | None:
        return re.search(r"training on (\S+): (not better|better)", graph.tail("inference_node", 100))

    peer.wait_until(lambda: ended() is not None, "the end of the training", WORK_S)
    found = ended()
    assert found is not None and found[1] == posteriors[-1].model
    trained = "balance-1" if found[2] == "better" else "balance-early"
    wanted = find_policy(trained, tmp_path / "store").policy_id
    peer.wait_until(lambda: in_use[-1].data == wanted, f"{trained} in use")
