"""`./tcbi doctor`: what is well and what is not, and what to do about it."""

import argparse

from tcbi_bringup.arguments import namespace
from tcbi_bringup.commands import console
from tcbi_contract.wording import counted

SUMMARY = "Check environment, versions, build, disk, rendering, ports, and the topics and rates of a running graph."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to look at."""
    parser.add_argument(
        "--port",
        default="",
        help="talk to the robot behind this serial port (servos and sensors are read, nothing moves); default: only "
        "see which ports are there and free",
    )
    console.add_robot_link(parser)
    parser.add_argument("--namespace", type=namespace, default="", help="of the running graph")
    parser.add_argument("--no-graph", action="store_true", help="leave out the running graph (saves seven seconds)")
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser, "./tcbi doctor", "./tcbi doctor --port /dev/rfcomm0", "ROS_DOMAIN_ID=7 ./tcbi doctor --json"
    )


def run(args: argparse.Namespace) -> int:
    """All checks; 1 if there is a fault."""
    from tcbi_bringup.doctor import environment_checks, port_checks, robot_checks
    from tcbi_bringup.domain_lock import present_domain
    from tcbi_bringup.errors import WrongCallError
    from tcbi_bringup.graph_check import graph_checks
    from tcbi_contract.check import FAULT, WARNING

    link = (args.sensor_port, args.calibration, args.baud_rate, args.sensor_baud_rate)
    options = ("--sensor-port", "--calibration", "--baud-rate", "--sensor-baud-rate")
    for option, value in zip(options, link, strict=True):
        if value and not args.port:
            raise WrongCallError(f"{option}: got it without --port; give the servo bus's port with --port")
    checks = [*environment_checks(console.store_folder(args.store))]
    checks += robot_checks(args.port, *link) if args.port else port_checks()
    if not args.no_graph and not any(c.name in ("interfaces", "domain") and c.status == FAULT for c in checks):
        checks += graph_checks(present_domain(), args.namespace)
    faults = sum(c.status == FAULT for c in checks)
    warnings = sum(c.status == WARNING for c in checks)
    if args.json:
        console.emit({"faults": faults, "warnings": warnings, "checks": checks})
        return 1 if faults else 0
    for check in checks:
        print(f"{check.status:8} {check.name}: {check.found}")
        if check.remedy:
            print(f"{'':8}   -> {check.remedy}")
    print(f"{counted(faults, 'fault')}, {counted(warnings, 'warning')}")
    return 1 if faults else 0
