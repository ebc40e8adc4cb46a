"""Whether the graph goes on at its rates while a policy is retrained, and how long a retraining and its end take.

./tcbi python bench/retraining.py            # one of 120 s, as the inference node asks for; three cancelled ones
./tcbi python bench/retraining.py --task forward
./tcbi python bench/retraining.py --quick    # one of 20 s, one cancelled

A simulation in real time, a policy that acts, a recorder and the retraining server, as `./tcbi up --robot sim` starts
them. Rates are those that a listener hears before the training and during it.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import domain_coordinator
import numpy as np
from lockstep import Outsider
from rclpy.action import ActionClient
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.commands.bench import figure
from tcbi_bringup.launcher import Graph
from tcbi_bringup.robot_graph import GraphOptions, companion_processes, robot_processes
from tcbi_contract import messages, names
from tcbi_msgs.action import Retrain

POLICIES = {"balance": "balance-early", "forward": "forward"}  # in use, and to start from
REST_S = 20.0  # of the rates before
CANCEL_AFTER_S = 8.0
LONGEST_S = 600.0  # of a retraining
STREAMS = {names.JOINT_STATES: JointState, names.IMU: Imu, names.JOINT_COMMANDS: JointTrajectory}


class Listener(Outsider):
    """Hears the graph's topics and asks for retrainings."""

    def __init__(self, task: str) -> None:
        super().__init__("bench_retraining")
        self.task = task
        self.heard: dict[str, list[float]] = {topic: [] for topic in STREAMS}
        for topic, kind in STREAMS.items():
            take = self._taker(topic)
            self.node.create_subscription(kind, topic, take, messages.STREAM_QOS, raw=True)
        self.enable = self.node.create_client(SetBool, names.ENABLE_POLICY)
        self.retraining = ActionClient(self.node, Retrain, names.RETRAIN)

    def _taker(self, topic: str) -> Callable[[bytes], None]:
        return lambda _: self.heard[topic].append(time.monotonic())

    def listen(self, seconds: float) -> None:
        """Spin for so long."""
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, "a while", 2 * seconds)

    def begin(self, budget_s: float) -> tuple[Any, Any]:
        """Ask for a retraining from the policy in use; the goal's handle and the future of its result."""
        sent = self.retraining.send_goal_async(Retrain.Goal(task=self.task, budget_s=budget_s, seed=1))
        self.wait(sent.done, "the goal")
        handle = sent.result()
        return handle, handle.get_result_async()

    def take(self) -> dict[str, np.ndarray]:
        """Arrival times of each topic since the last call, s."""
        found = {topic: np.array(times) for topic, times in self.heard.items()}
        for times in self.heard.values():
            times.clear()
        return found


def rate(times: np.ndarray) -> float:
    """Messages a second."""
    return float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 0.0


def figures_of(listener: Listener, budget_s: float, cancelled: int) -> list[dict[str, Any]]:
    """One retraining to its end, and some that are cancelled."""
    listener.wait(listener.enable.service_is_ready, "the policy node")
    listener.wait(listener.retraining.server_is_ready, "the retraining server")
    answer = listener.enable.call_async(SetBool.Request(data=True))
    listener.wait(answer.done, "the policy's answer")
    listener.wait(lambda: len(listener.heard[names.JOINT_COMMANDS]) > 10, "ten commands")
    listener.take()
    listener.listen(REST_S)
    before, began = listener.take(), time.monotonic()
    _, result = listener.begin(budget_s)
    listener.wait(result.done, "the retraining", LONGEST_S)
    took, during = time.monotonic() - began, listener.take()
    outcome = result.result().result
    sys.stderr.write(f"{outcome.message}\n")
    if not outcome.success:
        raise RuntimeError(outcome.message)
    ends = []
    for _ in range(cancelled):
        handle, result = listener.begin(budget_s)
        listener.listen(CANCEL_AFTER_S)
        asked = time.monotonic()
        handle.cancel_goal_async()
        listener.wait(result.done, "the end of a cancelled retraining")
        ends.append(time.monotonic() - asked)
    found = [
        figure(
            f"{listener.task}, {topic}: rate while training to before",
            rate(during[topic]) / rate(before[topic]),
            "1",
            least=0.98,
        )
        for topic in STREAMS
    ]
    longest = float(np.diff(during[names.JOINT_COMMANDS]).max())
    return [
        *found,
        figure(
            f"{listener.task}: longest time between two commands while training",
            longest,
            "s",
            most=2 * names.CONTROL_PERIOD_S,
        ),
        figure(
            f"{listener.task}: a retraining with a budget of {budget_s:g} s, with its comparison", took, "s", most=180.0
        ),
        figure(
            f"{listener.task}: return on held-out draws, after less before",
            outcome.return_after - outcome.return_before,
            "1",
        ),
        figure(f"{listener.task}: end of a cancelled retraining, median", statistics.median(ends), "s", most=1.0),
    ]


def measure(task: str, budget_s: float, cancelled: int, store: Path) -> list[dict[str, Any]]:
    """The figures."""
    options = GraphOptions(store=store, policy=POLICIES[task], task=task)
    with domain_coordinator.domain_id() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        processes = robot_processes(options, store) + companion_processes(options)
        with Graph(processes, domain_id=domain, log_dir=store / "log"):
            listener = Listener(task)
            try:
                return figures_of(listener, budget_s, cancelled)
            finally:
                listener.close()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 s of training, one cancelled")
    parser.add_argument("--task", choices=POLICIES, default="balance")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(options.task, *((20.0, 1) if options.quick else (120.0, 3)), Path(folder))
    print(json.dumps({"name": "retraining", "figures": figures}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
