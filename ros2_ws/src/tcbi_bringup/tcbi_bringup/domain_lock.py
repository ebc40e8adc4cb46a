"""One graph per ROS domain and namespace: two would mix their topics without a word."""

import fcntl
import os
import tempfile
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from tcbi_bringup.errors import LaunchError, RobotListensError, SecondGraphError
from tcbi_bringup.graph_monitor import GraphMonitor
from tcbi_contract.names import CLOCK, FOOT_CONTACTS, IMU, JOINT_COMMANDS, JOINT_STATES, TRACKER_POSE

OWN_NODES = ("sim_node", "driver_node", "policy_node", "recorder_node", "inference_node", "retrain_node")
ROBOT_NODES = ("sim_node", "driver_node")  # they follow joint_commands
SENSOR_TOPICS = (JOINT_STATES, IMU, FOOT_CONTACTS, TRACKER_POSE)  # of which a robot is the one publisher
DISCOVERY_S = 4.0  # what a busy machine was seen to need, and a margin
DOMAINS = range(0, 233)
REMEDY = "stop that one, or choose another domain (ROS_DOMAIN_ID=1 ./tcbi up …) or another --namespace"


def present_domain() -> int:
    """ROS_DOMAIN_ID, 0 if it is not set.

    Raises:
      LaunchError: it is not a domain.
    """
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) not in DOMAINS:
        raise LaunchError(
            f"ROS_DOMAIN_ID: got {text!r}, allowed is an integer from 0 to {DOMAINS[-1]}; set it or unset it"
        )
    return int(text)


@contextmanager
def hold_domain(domain_id: int, namespace: str = "") -> Iterator[None]:
    """Keep other launchers on this host out of a domain and namespace.

    Raises:
      SecondGraphError: one holds it already.
    """
    name = (
        f"tcbi-{os.getuid()}-domain-{domain_id}{'-' + namespace.strip('/').replace('/', '-') if namespace else ''}.lock"
    )
    own = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    path = (own if os.access(own, os.W_OK) else Path(tempfile.gettempdir())) / name
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise SecondGraphError(
                f"a graph already runs in ROS domain {domain_id}{_in(namespace)} (process {holder}); {REMEDY}"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield
        file.truncate(0)


def refuse_second_graph(
    monitor: GraphMonitor,
    domain_id: int,
    namespace: str = "",
    patience_s: float = DISCOVERY_S,
    own_clock: bool = False,
) -> None:
    """Look for the nodes of another graph, which may run on another machine, for as long as discovery takes.

    Args:
      own_clock: the new graph publishes `/clock`, of which a domain has one, whatever the namespaces.

    Raises:
      SecondGraphError: names the nodes found.
    """
    prefix = f"/{namespace.strip('/')}/" if namespace else "/"
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        found = sorted({prefix + name for name in OWN_NODES} & monitor.node_names())
        if found:
            raise SecondGraphError(
                f"a graph already runs in ROS domain {domain_id}{_in(namespace)}: found {', '.join(found)}; {REMEDY}"
            )
        if own_clock and monitor.publishers(CLOCK):
            raise SecondGraphError(
                f"a simulated clock runs in ROS domain {domain_id} already; stop that one, or choose another domain "
                "(ROS_DOMAIN_ID=1 ./tcbi up …)"
            )
        time.sleep(0.05)


def refuse_beside_robot(
    topics: Collection[str], namespace: str = "", drive: bool = False, patience_s: float = DISCOVERY_S
) -> None:
    """Look for a robot or a simulation that what is played would move or contradict, as long as discovery takes.

    Args:
      topics: what is played; of no concern are those that are neither commands nor a robot's own.
      drive: it may be moved.

    Raises:
      RobotListensError: there is one.
    """
    faults = ["its joint_commands would move it"] if JOINT_COMMANDS in topics and not drive else []
    if recorded := [topic for topic in SENSOR_TOPICS if topic in topics]:
        faults.append(f"its {', '.join(recorded)} would mix with what is measured now")
    if not faults:
        return
    domain_id = present_domain()
    prefix = f"/{namespace}/" if namespace else "/"
    deadline = time.monotonic() + patience_s
    with GraphMonitor(domain_id, namespace) as monitor:
        while time.monotonic() < deadline:
            found = sorted({prefix + name for name in ROBOT_NODES} & monitor.node_names())
            if found:
                raise RobotListensError(
                    f"{found[0]} runs in ROS domain {domain_id}{_in(namespace)}, and the bag is not played beside it: "
                    f"{', '.join(faults)}; play it into a graph without a robot (./tcbi up --robot none), in another "
                    "domain (ROS_DOMAIN_ID), or to move the robot its commands alone (--topics joint_commands --drive)"
                )
            time.sleep(0.05)


def _in(namespace: str) -> str:
    return f", namespace /{namespace.strip('/')}" if namespace else ""
