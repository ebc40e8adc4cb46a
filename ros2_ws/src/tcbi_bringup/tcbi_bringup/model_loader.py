"""Has the nodes of a running graph take another model version, without a restart; needs ROS."""

import dataclasses
import time

import rclpy
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor

from tcbi_bringup.errors import BringupError
from tcbi_contract import names
from tcbi_msgs.srv import LoadModel

TAKERS = {"sim node": names.LOAD_MODEL, "inference node": names.INFERENCE_LOAD_MODEL}
FOUND_S = 10.0  # until a node is given up that the graph does not show
MORE_S = 2.0  # for the others, once one is there
ANSWER_S = 30.0


@dataclasses.dataclass(frozen=True)
class Taken:
    """What a node answered.

    Attributes:
      model: the version that it has now; "" where it did not answer.
      problem: why it is not the one asked for; "" where it is.
    """

    node: str
    model: str
    problem: str = ""


def load_model(version: str, namespace: str = "") -> list[Taken]:
    """Ask the sim node and the inference node, those that run, to take a version.

    Raises:
      BringupError: neither runs.
    """
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node(
            "model_loader", context=context, namespace=namespace.strip("/") or None, enable_rosout=False
        )
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        clients = {name: node.create_client(LoadModel, service) for name, service in TAKERS.items()}
        ready = _ready(clients, executor)
        if not ready:
            raise BringupError(
                f"no node of a graph offers {' or '.join(TAKERS.values())} after {FOUND_S:g} s: start one with "
                "./tcbi up, and look at ROS_DOMAIN_ID and --namespace if one runs"
            )
        return [_asked(name, clients[name], version, executor) for name in ready]
    finally:
        rclpy.shutdown(context=context)


def _ready(clients: dict[str, Client], executor: SingleThreadedExecutor) -> list[str]:
    """The nodes that are there."""
    deadline = time.monotonic() + FOUND_S
    found: list[str] = []
    while time.monotonic() < deadline and len(found) < len(clients):
        executor.spin_once(timeout_sec=0.1)
        there = [name for name, client in clients.items() if client.service_is_ready()]
        if there and not found:
            deadline = time.monotonic() + MORE_S
        found = there
    return found


def _asked(name: str, client: Client, version: str, executor: SingleThreadedExecutor) -> Taken:
    future = client.call_async(LoadModel.Request(model=version))
    executor.spin_until_future_complete(future, ANSWER_S)
    answer = future.result() if future.done() else None
    if answer is None:
        return Taken(name, "", f"did not answer within {ANSWER_S:g} s; look at its log")
    return Taken(name, answer.model, "" if answer.success else answer.message)
