"""How much faster than real time the graph runs in lockstep, with the policy and the recorder attached; what gets lost.

./tcbi python bench/lockstep.py            # five rollouts of 8 s
./tcbi python bench/lockstep.py --quick    # two of 4 s

Prints one JSON object: the ratio of simulated to wall time while episodes run (from the first command to the end of the
duration), and from BEGIN to the END that follows the closed bag; the samples missing from the bags; and whether
rollouts of one seed are equal byte for byte.
"""

import argparse
import hashlib
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
import rclpy
from mcap.reader import make_reader
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock as ClockMessage

from tcbi_bringup.commands.bench import figure
from tcbi_bringup.launcher import Graph
from tcbi_bringup.robot_graph import GraphOptions, companion_processes, robot_processes
from tcbi_contract import messages, names
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.msg import RolloutEvent

TARGET_RATIO = 10.0
STREAMS = (names.JOINT_STATES, names.IMU, names.FOOT_CONTACTS, names.TRACKER_POSE)
DEADLINE_S = 120.0


class Outsider:
    """A node beside the graph, which spins while it waits."""

    def __init__(self, name: str) -> None:
        rclpy.init()
        self.node = rclpy.create_node(name)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)

    def wait(self, done: Callable[[], bool], what: str, timeout_s: float = DEADLINE_S) -> None:
        """Spin until `done()`."""
        deadline = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what}: not within {timeout_s:g} s")
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """End the node."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown()


class Collection(Outsider):
    """Asks the graph for rollouts and times them from outside."""

    def __init__(self) -> None:
        super().__init__("bench_lockstep")
        self.seen: list[tuple[int, float]] = []
        self.clock: list[tuple[float, float]] = []  # simulated and wall time, s
        self.node.create_subscription(ClockMessage, names.CLOCK, self._tick, messages.STREAM_QOS)
        self.node.create_subscription(RolloutEvent, names.ROLLOUT_EVENT, self._take, messages.LATCHED_QOS)
        self.client = ActionClient(self.node, CollectRollouts, names.COLLECT_ROLLOUTS)

    def _tick(self, message: ClockMessage) -> None:
        now = messages.seconds(message.clock)
        if not self.clock or now > self.clock[-1][0]:
            self.clock.append((now, time.monotonic()))

    def _take(self, event: RolloutEvent) -> None:
        self.seen.append((event.kind, time.monotonic()))

    def collect(self, number: int, duration_s: float) -> tuple[list[float], list[float], list[Path]]:
        """Ratios (running, whole) and bags of rollouts of one seed, one goal each, so that all are alike."""
        self.wait(lambda: self.client.server_is_ready() and bool(self.clock), "the recorder and the clock")
        running, whole, bags = [], [], []
        for _ in range(number):
            apart = time.monotonic() + 1.1  # bags are named by the second
            self.wait(lambda apart=apart: time.monotonic() > apart, "a second")
            self.seen.clear()
            self.clock.clear()
            goal = CollectRollouts.Goal(task="balance", policy="gait:dither", number=1, seed=3, duration_s=duration_s)
            accepted = self.client.send_goal_async(goal)
            self.wait(accepted.done, "the goal")
            result = accepted.result().get_result_async()
            self.wait(result.done, "the rollout")
            if not result.result().result.success:
                raise RuntimeError(result.result().result.message)
            bags += [Path(bag) for bag in result.result().result.bags]
            self.wait(lambda: any(kind == RolloutEvent.END for kind, _ in self.seen), "END")
            times = dict(self.seen)
            whole.append(duration_s / (times[RolloutEvent.END] - times[RolloutEvent.BEGIN]))
            (first, began), (last, ended) = self.clock[1], self.clock[-1]  # the clock's first value is the reset's
            running.append((last - first) / (ended - began))
        return running, whole, bags


def contents(bag: Path) -> dict[str, list[bytes]]:
    """Serialized sensor messages by topic."""
    found: dict[str, list[bytes]] = {topic: [] for topic in STREAMS}
    with next(bag.glob("*.mcap")).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.lstrip("/") in found:
                found[channel.topic.lstrip("/")].append(message.data)
    return found


def digest(found: dict[str, list[bytes]]) -> str:
    """Of all messages without their stamps, which the first 12 bytes hold after the 4 of the encapsulation."""
    bodies = (message[12:] for topic in STREAMS for message in found[topic])
    return hashlib.sha256(b"".join(bodies)).hexdigest()


def measure(number: int, duration_s: float, store: Path) -> list[dict[str, Any]]:
    """The figures."""
    options = GraphOptions(store=store, lockstep=True, learning=False)
    with domain_coordinator.domain_id() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        processes = robot_processes(options, store) + companion_processes(options)
        with Graph(processes, domain_id=domain, log_dir=store / "log"):
            collection = Collection()
            try:
                running, whole, bags = collection.collect(number, duration_s)
            finally:
                collection.close()
    found = [contents(bag) for bag in bags]
    wanted = round(duration_s * names.SENSOR_RATE_HZ) + 1
    lost = sum(wanted - len(seen) for bag in found for seen in bag.values())
    different = len({digest(bag) for bag in found}) - 1
    return [
        figure("simulated to wall time, running, median", statistics.median(running), "1", least=TARGET_RATIO),
        figure("simulated to wall time, running, slowest", min(running), "1", least=TARGET_RATIO),
        figure("simulated to wall time, BEGIN to END, median", statistics.median(whole), "1", least=TARGET_RATIO),
        figure("sensor messages missing from the bags", lost, "1", most=0),
        figure("rollouts of one seed that differ", different, "1", most=0),
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two short rollouts")
    options = parser.parse_args()
    number, duration_s = (2, 4.0) if options.quick else (5, 8.0)
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(number, duration_s, Path(folder))
    print(json.dumps({"name": "lockstep", "figures": figures}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
