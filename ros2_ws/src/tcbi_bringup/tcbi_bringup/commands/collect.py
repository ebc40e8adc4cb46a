"""`./tcbi collect`: records rollouts of a task."""

import argparse
import contextlib
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import at_least, namespace
from tcbi_bringup.commands import console
from tcbi_bringup.errors import BringupError, WrongCallError

SUMMARY = "Record rollouts of a task, one bag each, from the running graph or from one that is started for it."
READY_S = 40.0  # for the nodes to be there
DISTANCE_S = 600.0  # for the operator to measure a distance
QUIET_S = 3.0  # of these before it is said what is waited for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to record, how often, from which robot."""
    console.add_task(parser, default="balance")
    parser.add_argument("--n", type=at_least(1), default=1, dest="number", help="number of rollouts (default: 1)")
    parser.add_argument(
        "--seed", type=at_least(0), default=0, help="slopes, blocks and postures are drawn from it (default: 0)"
    )
    console.add_hidden(parser)
    parser.add_argument(
        "--robot",
        default="running",
        metavar="running|sim|emulated|PORT",
        help="the graph that runs (default), or a graph started for this: simulation, emulated robot, real robot",
    )
    parser.add_argument(
        "--policy",
        default="",
        help="a .safetensors file, a policy of the store, gait:NAME, or none; default: the one that is loaded",
    )
    console.add_robot_link(parser)
    parser.add_argument("--duration", type=at_least(0.0), default=0.0, metavar="S", help="default: the task's own")
    parser.add_argument(
        "--slope-roll", type=float, nargs="+", default=[], metavar="RAD", help="one a rollout; else drawn"
    )
    parser.add_argument(
        "--slope-pitch", type=float, nargs="+", default=[], metavar="RAD", help="one a rollout; else drawn"
    )
    parser.add_argument(
        "--model", default="", help="model version to simulate; default: the present one, or the latest"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="where the bags go; default: the recorder's own folder"
    )
    parser.add_argument("--realtime", action="store_true", help="simulate in real time (with --robot sim)")
    parser.add_argument(
        "--ask-distance", action="store_true", help="ask for the distance after each rollout (no tracker)"
    )
    parser.add_argument(
        "--place", action="store_true", help="say what ground to set before each rollout, and wait for Enter"
    )
    parser.add_argument("--namespace", type=namespace, default="", help="of the graph")
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi collect --task balance --n 5 --seed 1",
        "./tcbi collect --robot sim --task forward --n 3 --policy gait:tripod --out bags",
        "./tcbi collect --robot emulated --task balance --n 10 --json",
        "./tcbi collect --robot emulated --hidden backlash --seed 7 --policy gait:steps --n 4",
        "./tcbi collect --robot /dev/rfcomm0 --calibration my_robot.toml --n 5 --place --ask-distance",
    )


def run(args: argparse.Namespace) -> int:
    """Ask the recorder of the graph; Ctrl-C aborts the rollout that runs and keeps those that are over."""
    from tcbi_bringup.domain_lock import present_domain
    from tcbi_infer.collection import Request, check, recorded

    request = Request(
        task=args.task,
        number=args.number,
        seed=args.seed,
        policy=args.policy,
        slope_roll=tuple(args.slope_roll),
        slope_pitch=tuple(args.slope_pitch),
        duration_s=args.duration,
        model=args.model,
        folder=str(args.out.resolve()) if args.out else "",
        distance_timeout_s=DISTANCE_S if args.ask_distance else 0.0,
    )
    check(request)
    domain = present_domain()
    with (
        _graph(args, domain) as check_graph,
        console.progress("recording", total=args.number, unit="rollouts") as advance,
    ):
        result, succeeded = _ask(args, domain, request, advance, check_graph)
    if args.json:
        console.emit({"success": succeeded, "message": result.message, "bags": list(result.bags)})
    else:
        for bag in result.bags:
            print(bag)
        if succeeded and result.message != recorded(len(result.bags)):
            console.note(result.message)
    if not succeeded:
        from tcbi_infer.errors import RecordingError

        raise RecordingError(f"{len(result.bags)} of {args.number} rollouts recorded: {result.message}")
    return 0


@contextlib.contextmanager
def _graph(args: argparse.Namespace, domain: int) -> Iterator[Callable[[], None]]:
    """The graph to record from, nothing to do for one that runs; yields what raises if a process of it has failed."""
    if args.realtime and args.robot != "sim":
        raise WrongCallError(f"--realtime: got --robot {args.robot}, allowed is sim; a robot has no other time")
    if args.robot == "none":
        raise WrongCallError(
            "--robot: got none, allowed is running, sim, emulated or a serial port; nothing moves without a robot"
        )
    if args.robot == "running":
        if args.hidden or args.strength:
            raise WrongCallError(
                "--hidden and --strength: got --robot running, allowed is emulated; that robot is built for this call"
            )
        if args.sensor_port or args.calibration or args.baud_rate or args.sensor_baud_rate:
            raise WrongCallError(
                "--sensor-port, --calibration and the baud rates: got --robot running, allowed is a serial port; the "
                "graph that runs has its own driver"
            )
        yield lambda: None
        return
    from tcbi_bringup.domain_lock import hold_domain, refuse_second_graph
    from tcbi_bringup.graph_monitor import GraphMonitor
    from tcbi_bringup.launcher import Graph
    from tcbi_bringup.robot_graph import SIM, newest_model, start_graph

    options = console.graph_options(
        args,
        policy=args.policy if args.policy != "none" else "",
        lockstep=args.robot == "sim" and not args.realtime,
        learning=False,
        recordings=args.out.resolve() if args.out else None,
    )
    options.check()
    with (
        hold_domain(domain, options.namespace),
        tempfile.TemporaryDirectory(prefix="tcbi-") as folder,
        Graph(domain_id=domain) as graph,
    ):
        with GraphMonitor(domain, options.namespace) as monitor:
            refuse_second_graph(monitor, domain, options.namespace, own_clock=options.lockstep)
        if args.robot == SIM:
            console.note_model(args.model, newest_model(options.store))
        console.note(f"starting {args.robot}; logs in {graph.log_dir}")
        start_graph(graph, options, Path(folder))
        yield graph.check_briefly
        graph.check_briefly()


def _ask(
    args: argparse.Namespace, domain: int, request: Any, advance: Any, check_graph: Callable[[], None]
) -> tuple[Any, bool]:
    """Send the goal, show its progress, return its result and whether it succeeded."""
    from tcbi_infer.collect_client import CollectClient

    with CollectClient(domain, args.namespace) as client:
        client.while_waiting = _patient(domain, check_graph)
        if args.ask_distance:
            client.on_distance = _ask_distance
        if args.place:
            client.offer_place(_place)
        client.on_progress = lambda done, name, left: advance(done=done, note=f"{name}, {left:.0f} s left")
        return client.collect(request, READY_S)


def _patient(domain: int, check_graph: Callable[[], None]) -> Callable[[], None]:
    """What to call while the recorder is waited for: after some seconds it says once what is missing, and where."""
    begin, said = time.monotonic(), False

    def waiting() -> None:
        nonlocal said
        check_graph()
        if not said and time.monotonic() - begin > QUIET_S:
            said = True
            console.note(f"waiting up to {READY_S:g} s for the recorder of a graph in ROS domain {domain}")

    return waiting


def _place(request: Any) -> None:
    """Tell the operator which ground to set."""
    console.note(
        f"ground: roll {math.degrees(request.slope_roll):.1f}, pitch {math.degrees(request.slope_pitch):.1f} degrees"
        + (f"; the robot heads {math.degrees(request.yaw):.0f} degrees to the left" if request.yaw else "")
    )
    for block in request.blocks:
        c, s = block.center, block.size
        console.note(
            f"  block {s.x:.2f} x {s.y:.2f} x {s.z:.2f} m, its middle {c.x:.2f} m ahead and {c.y:.2f} m to the left, "
            f"turned by {math.degrees(block.yaw):.0f} degrees"
        )
    _answer("place the robot, then press Enter; if it has gone limp, it moves into its posture then: ")


def _ask_distance(rollout_id: str) -> float:
    """What the operator measured, m."""
    while True:
        answer = _answer(f"{rollout_id}: distance in m (empty if unknown): ")
        if not answer:
            return math.nan
        with contextlib.suppress(ValueError):
            if math.isfinite(distance := float(answer)):
                return distance
        console.note(f"{answer!r} is no number of metres")


def _answer(question: str) -> str:
    """The line that the operator types.

    Raises:
      BringupError: there is nobody to ask.
    """
    print(question, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline() if sys.stdin else ""
    if not line:
        print(file=sys.stderr)
        raise BringupError("standard input has ended, so nobody can answer --place or --ask-distance; use a terminal")
    return line.strip()
