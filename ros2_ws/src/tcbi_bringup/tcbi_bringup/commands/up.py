"""`./tcbi up`: starts the graph, shows it, keeps it running, and ends it."""

import argparse
import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tcbi_bringup.arguments import at_least, folder_path, namespace, node_parameter
from tcbi_bringup.commands import console

SUMMARY = "Start the graph of nodes on a simulation, an emulated robot, a real one or none; Ctrl-C stops all of it."
INTERRUPTED = 130
ROBOT = "default: sim; none starts all the rest, on the clock of the ./tcbi replay that feeds it (docs/bags.md)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to start."""
    parser.add_argument("--robot", default="sim", metavar="sim|emulated|none|PORT", help=ROBOT)
    console.add_task(parser, ": terrain that the simulation starts with")
    parser.add_argument(
        "--policy", default="", help="what acts: a .safetensors file, a policy of the store, or gait:NAME"
    )
    console.add_model(parser, "model version to simulate, and to infer the parameters of")
    parser.add_argument("--lockstep", action="store_true", help="simulate as fast as it goes, with /clock (sim only)")
    parser.add_argument(
        "--namespace", type=namespace, default="", help="put before every topic, for several robots in one domain"
    )
    parser.add_argument(
        "--seed", type=at_least(0), default=0, help="of the simulation or the emulated robot (default: 0)"
    )
    console.add_robot_link(parser)
    parser.add_argument(
        "--bags",
        type=Path,
        metavar="FOLDER",
        help="where rollouts are recorded, and where the inference node looks for them (default: in the store)",
    )
    console.add_hidden(parser)
    parser.add_argument("--no-learning", action="store_true", help="leave out the inference and the retrain node")
    parser.add_argument(
        "--set",
        type=node_parameter,
        action="append",
        default=[],
        metavar="NODE.PARAMETER=VALUE",
        help="set a parameter of a node (docs/parameters.md lists them all); may be given several times",
    )
    parser.add_argument(
        "--log-dir", type=folder_path, help="where the processes' logs go (default: a new folder, named at start)"
    )
    console.add_store(parser)
    console.add_examples(
        parser,
        "./tcbi up",
        "./tcbi up --robot emulated --policy gait:tripod --bags rollouts",
        "./tcbi up --robot emulated --hidden payload --strength weak --seed 7",
        "./tcbi up --robot /dev/rfcomm0 --calibration my_robot.toml",
        "./tcbi up --set inference_node.posterior_moved=1.0 --set inference_node.least_rollouts=20",
        "./tcbi up --robot none --bags replayed     # then, in another terminal: ./tcbi replay BAG",
        "ROS_DOMAIN_ID=7 ./tcbi up --lockstep --task forward",
    )


def run(args: argparse.Namespace) -> int:
    """Start, show until the end is asked for, stop."""
    from tcbi_bringup.domain_lock import hold_domain, present_domain, refuse_second_graph
    from tcbi_bringup.graph_monitor import GraphMonitor
    from tcbi_bringup.launcher import Graph
    from tcbi_bringup.node_parameters import Setting
    from tcbi_bringup.robot_graph import SIM, newest_model, start_graph

    options = console.graph_options(
        args,
        policy=args.policy,
        lockstep=args.lockstep,
        learning=not args.no_learning,
        recordings=args.bags.expanduser().resolve() if args.bags else None,
        settings=tuple(Setting(*given) for given in args.set),
    )
    options.check()
    domain, folder = present_domain(), log_folder(args.log_dir)
    asked = end_requests()
    with hold_domain(domain, options.namespace), GraphMonitor(domain, options.namespace) as monitor:
        refuse_second_graph(monitor, domain, options.namespace, own_clock=options.lockstep)
        if asked():
            return INTERRUPTED
        if options.robot == SIM:
            console.note_model(args.model, newest_model(options.store))
        with (
            tempfile.TemporaryDirectory(prefix="tcbi-") as run_folder,
            Graph(domain_id=domain, log_dir=folder, restart=True) as graph,
        ):
            start_graph(graph, options, Path(run_folder), asked)
            failure = watch(graph, monitor, options, f"ROS domain {domain}, logs in {folder}", asked)
            console.note("stopping")
            codes = graph.stop(*(s.name for s in graph.status() if s.name != "emulated_robot"))
            codes |= graph.stop()  # the emulated robot last, so that nobody loses it before
    return report(failure, codes)


def log_folder(given: Path | None) -> Path:
    """A new folder for the logs of this run."""
    base = Path(os.environ.get("ROS_LOG_DIR") or Path.home() / ".ros" / "log")
    folder = given or base / f"up-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def end_requests() -> Callable[[], bool]:
    """Take Ctrl-C and SIGTERM as the wish to end; the result says whether one has come. A second one interrupts."""
    came: list[int] = []

    def on_signal(number: int, _: object) -> None:
        came.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    return lambda: bool(came)


def watch(graph, monitor, options, title: str, asked: Callable[[], bool]) -> str:
    """Show the graph until its end is asked for; returns why it cannot go on, or ""."""
    from tcbi_bringup.expectations import EXPECTATIONS
    from tcbi_bringup.live_view import show
    from tcbi_bringup.robot_graph import NONE

    monitor.watch({expected.topic: expected.type_name for expected in EXPECTATIONS})
    monitor.watch_health()
    lost: list[str] = []

    def goes_on() -> bool:
        for status in graph.status():
            if status.state == "given up" and status.essential and not lost:
                lost.append(graph.explain(status))
        return not asked() and not lost

    def look() -> tuple:
        return graph.status(), monitor.rates(), monitor.complaints()

    robot = "no robot" if options.robot == NONE else options.robot
    show(f"{robot}: {title}", look, goes_on, options.simulated_time)
    for status in graph.status():
        if status.state == "given up" and not status.essential:
            console.note(graph.explain(status))
    return lost[0] if lost else ""


def report(failure: str, codes: dict[str, int]) -> int:
    """The last line and the exit status."""
    from tcbi_bringup.errors import LaunchError
    from tcbi_bringup.launcher import describe_exit

    if failure:
        raise LaunchError(failure)
    unclean = {name: code for name, code in codes.items() if code}
    for name, code in unclean.items():
        console.note(f"{name} ended with {describe_exit(code)}")
    console.note(f"all {len(codes)} processes stopped")
    return 0
