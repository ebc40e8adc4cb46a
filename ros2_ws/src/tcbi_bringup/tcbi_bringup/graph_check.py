"""The checks of `./tcbi doctor` on a running graph: nodes, topics, types and rates against the contract."""

import time
from collections.abc import Iterator

from tcbi_bringup.domain_lock import OWN_NODES
from tcbi_bringup.expectations import EXPECTATIONS, RATE_TOLERANCE, Expectation, judge_rate
from tcbi_bringup.graph_monitor import GraphMonitor, TopicRate
from tcbi_contract import names
from tcbi_contract.check import FAULT, OK, WARNING, Check

DISCOVERY_S = 3.0
LISTEN_S = 4.0
ROBOTS = ("sim_node", "driver_node")


def graph_checks(domain_id: int, namespace: str = "") -> Iterator[Check]:
    """Listen to the domain for some seconds, and judge what is there."""
    prefix = f"/{namespace.strip('/')}/" if namespace else "/"
    with GraphMonitor(domain_id, namespace) as monitor:
        nodes = find_nodes(monitor, prefix)
        if not nodes:
            where = f"ROS domain {domain_id}" + (f", namespace {prefix.rstrip('/')}" if namespace else "")
            yield Check("graph", OK, f"none runs in {where}; ./tcbi up starts one")
            return
        yield nodes_check(nodes)
        monitor.watch({expected.topic: expected.type_name for expected in EXPECTATIONS})
        time.sleep(LISTEN_S)
        simulated = monitor.publishers(names.CLOCK) > 0
        types, rates = monitor.topic_types(), monitor.rates()
    for expected in EXPECTATIONS:
        seen = types.get(prefix + expected.topic, [])
        yield topic_check(expected, seen, rates[expected.topic], simulated, bool(set(nodes) & set(ROBOTS)))


def find_nodes(monitor: GraphMonitor, prefix: str) -> list[str]:
    """This project's nodes in the namespace, waiting as long as discovery takes."""
    deadline = time.monotonic() + DISCOVERY_S
    while time.monotonic() < deadline and not all(prefix + name in monitor.node_names() for name in OWN_NODES):
        time.sleep(0.05)
    return sorted(name for name in OWN_NODES if prefix + name in monitor.node_names())


def nodes_check(nodes: list[str]) -> Check:
    """Is there one robot, and only one."""
    robots = [name for name in nodes if name in ROBOTS]
    found = ", ".join(nodes)
    if len(robots) > 1:
        return Check(
            "graph", FAULT, f"{found}: a robot and a simulation at once", "stop one, or give one a --namespace"
        )
    if not robots:
        return Check("graph", WARNING, f"{found}: no robot and no simulation", "start one: ./tcbi up")
    return Check("graph", OK, found)


def topic_check(expected: Expectation, types: list[str], seen: TopicRate, simulated: bool, has_robot: bool) -> Check:
    """One topic against the contract.

    Args:
      expected: what the contract says.
      types: of the topic in the domain.
      seen: what was counted.
      simulated: a clock of a simulation runs, so that rates by the wall say nothing.
      has_robot: a robot or a simulation is there.
    """
    label = f"topic {expected.topic}"
    if types and types != [expected.type_name]:
        return Check(
            label, FAULT, f"type {', '.join(types)}", f"the contract says {expected.type_name}; rename the other"
        )
    if seen.publishers > 1 and expected.publisher == "robot":
        return Check(
            label, FAULT, f"{seen.publishers} publishers", "two robots share this topic: stop one, or use --namespace"
        )
    if not seen.publishers or seen.age_s is None:
        quiet = "no publisher" if not seen.publishers else "no message"
        if expected.always and has_robot and not simulated:
            return Check(
                label, FAULT, quiet, f"{expected.publisher} should publish it; look into its log and diagnostics"
            )
        return Check(label, OK, f"{quiet} at present")
    found = f"{seen.rate_hz:.1f} Hz, {seen.publishers} publisher{'s' if seen.publishers > 1 else ''}"
    if expected.rate_hz is None or simulated:
        return Check(label, OK, found + (", on a simulated clock" if simulated else ""))
    if not judge_rate(expected.rate_hz, seen.rate_hz):
        allowed = f"the contract says {expected.rate_hz:g} Hz within {RATE_TOLERANCE:.0%}"
        return Check(label, WARNING, found, f"{allowed}; the machine may be overloaded, or the link slow")
    return Check(label, OK, found)
