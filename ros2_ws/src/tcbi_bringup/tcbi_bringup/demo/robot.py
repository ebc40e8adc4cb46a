"""The demo's robot: an emulated one behind a serial port, driven and recorded by the same nodes as a real one."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tcbi_bringup.demo.lab_node import LabNode, laboratory
from tcbi_bringup.domain_lock import hold_domain
from tcbi_bringup.errors import DemoError, SecondGraphError
from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_bringup.robot_graph import AFTER_CRASH

FIRST_POLICY = "balance-early"  # a short training, as a first attempt is
DOMAINS = range(60, 100)  # beyond 101 the ports of a domain may be taken by the system


@dataclass(frozen=True)
class Robot:
    """Which robot: its number, and what is hidden in it.

    Attributes:
      seed: number of the robot; its plain parameters follow from it.
      hidden: the hidden effect, "none", or "" to draw it from the seed.
      strength: "strong" or "weak".
    """

    seed: int
    hidden: str = ""
    strength: str = "strong"

    def arguments(self) -> tuple[str, ...]:
        """Of the program `emulated_robot`."""
        chosen = ("--hidden", self.hidden) if self.hidden else ()
        return ("--seed", str(self.seed), "--strength", self.strength, *chosen)


def processes(robot: Robot, folder: Path, store: Path, lab: Path) -> list[NodeProcess]:
    """The nodes of the demo: what a real robot would run, and the emulated robot behind the port.

    Args:
      robot: which.
      folder: of the rollouts.
      store: of models and policies.
      lab: a short path, for the port and the experimenter's socket (a socket's path has 107 bytes at most).
    """
    port, socket = lab / "robot.port", lab / "lab.sock"
    emulated = ("--link-path", str(port), "--socket", str(socket), *robot.arguments())
    return [
        NodeProcess("tcbi_bringup", "emulated_robot", arguments=emulated, ros=False, essential=True),
        NodeProcess(
            "hexapod_driver",
            "driver_node",
            parameters={"port": str(port), "approach_speed": 2.0, "posture_rest_s": 0.2},  # hands take it next
            after_crash=AFTER_CRASH,
            essential=True,
        ),
        NodeProcess(
            "tcbi_bringup", "experimenter_node", parameters={"socket": str(socket), "seed": robot.seed, "settle_s": 0.3}
        ),
        NodeProcess("tcbi_policy", "policy_node", parameters={"policy": "gait:stand", "store": str(store)}),
        NodeProcess("tcbi_infer", "recorder_node", parameters={"folder": str(folder / "rollouts")}),
        NodeProcess("tcbi_policy", "retrain_node", parameters={"store": str(store)}),
    ]


@contextlib.contextmanager
def running(robot: Robot, folder: Path, store: Path) -> Iterator[tuple[LabNode, Graph]]:
    """The graph in a ROS domain of its own, about to start; stopped cleanly at the end.

    `lab.wait(graph.check_briefly)` waits until it can record, and raises LaunchError where a process failed.
    """
    with _free_domain() as domain_id, contextlib.ExitStack() as stack:
        short = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tcbi-lab-")))
        graph = Graph(processes(robot, folder, store, short), domain_id=domain_id, log_dir=folder / "log", restart=True)
        stack.enter_context(graph)
        lab = stack.enter_context(laboratory(domain_id))
        yield lab, graph


@contextlib.contextmanager
def _free_domain() -> Iterator[int]:
    first = os.getuid() % len(DOMAINS)  # locks are a user's own, and users of one machine share its domains
    for domain_id in (*DOMAINS[first:], *DOMAINS[:first]):
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(hold_domain(domain_id))
            except SecondGraphError:
                continue
            yield domain_id
            return
    raise DemoError(f"no ROS domain from {DOMAINS[0]} to {DOMAINS[-1]} is free; stop some graphs")
