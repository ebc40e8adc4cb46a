"""The emulated robot as a program: a serial port to drive it, a socket for the experimenter's hands.

    emulated_robot --seed 7 --link-path robot.port                  # a hidden effect drawn from the seed
    emulated_robot --seed 7 --hidden backlash --strength weak
    emulated_robot --seed 7 --hidden none --ports 2                 # servo bus and sensor board on ports of their own
    emulated_robot --seed 7 --reveal                                # print the truth about robot 7 and end

It prints one line per port and one for the socket, then runs until Ctrl-C.
"""

import argparse
import contextlib
import json
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path

from hexapod_driver import calibration
from tcbi_bringup.arguments import at_least
from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.experimenter import ExperimenterServer, default_socket_path
from tcbi_bringup.emulated_robot.firmware import Electronics
from tcbi_bringup.emulated_robot.hidden_names import STRENGTHS, hidden
from tcbi_bringup.emulated_robot.live_body import LiveBody
from tcbi_bringup.emulated_robot.physics import Specimen
from tcbi_bringup.emulated_robot.port import PseudoTerminal, serve
from tcbi_contract.errors import TcbiError


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emulated_robot", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--seed", type=int, default=0, help="number of the robot: its parameters, and what is hidden in it")
    p.add_argument(
        "--hidden",
        type=hidden,
        metavar="EFFECT",
        help="the hidden effect, several joined by +, or none (default: drawn from the seed); docs/emulated_robot.md",
    )
    p.add_argument("--strength", choices=STRENGTHS, default=STRENGTHS[0], help="of the hidden effect (default: strong)")
    p.add_argument("--trial", type=at_least(0), default=0, help="draws the noise of sensors and bus (default: 0)")
    p.add_argument("--ports", type=int, choices=(1, 2), default=1, help="1: all over one link; 2: bus and board apart")
    p.add_argument(
        "--link-path", "--link", type=Path, help="symbolic link to the port; the second one's gets '-board' added"
    )
    p.add_argument("--socket", type=Path, help="the experimenter's socket (default: one a user and ROS domain)")
    p.add_argument("--calibration", default="", help="calibration file of the servos (default: the shipped one)")
    p.add_argument("--reveal", action="store_true", help="print the truth about this robot as JSON and end")
    return p


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; 0 on Ctrl-C, 1 with one line on what a user can mend, EX_SOFTWARE of a fault of its own."""
    options = parser().parse_args(args)
    logging.basicConfig(level=logging.WARNING, format="emulated_robot: %(message)s", stream=sys.stderr)
    try:
        return run(options)
    except TcbiError as error:
        print(f"emulated_robot: {error}", file=sys.stderr)
        return 1
    except Exception:  # noqa: BLE001 - nothing is hidden; the launcher tells a crash, as that of a node, from a mistake
        traceback.print_exc()
        return os.EX_SOFTWARE


def run(options: argparse.Namespace) -> int:
    """Be the robot until a signal comes."""
    specimen = Specimen.of(options.seed, options.hidden, options.strength)
    if options.reveal:
        print(json.dumps(specimen.truth()))
        return 0
    stop = threading.Event()
    body = LiveBody(specimen, options.trial)
    electronics = Electronics(body, calibration.load(options.calibration), options.ports)
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.signal(number, lambda *_: stop.set())
            stack.callback(signal.signal, number, before)
        server = stack.enter_context(ExperimenterServer(body, options.socket or default_socket_path()))
        terminals = [stack.enter_context(_terminal(link)) for link in _links(options.link_path, options.ports)]
        for terminal in terminals:
            print(f"port {terminal.path}", flush=True)
        print(f"socket {server.path}", flush=True)
        serve(electronics, terminals, stop)
        body.stop()
    return 0


def _links(link: Path | None, ports: int) -> list[Path | None]:
    second = None if link is None else link.with_name(f"{link.name}-board")
    return [link, second][:ports]


def _terminal(link: Path | None) -> PseudoTerminal:
    if link is not None and link.exists() and not link.is_symlink():
        raise EmulatedRobotError(f"--link-path {link} exists and is no symbolic link; choose another")
    try:
        return PseudoTerminal(link)
    except OSError as error:
        if link is None:
            raise EmulatedRobotError(f"cannot open a pseudo-terminal: {error}; is /dev/pts mounted?") from error
        raise EmulatedRobotError(f"cannot open a serial port at {link}: {error}; choose another folder") from error


if __name__ == "__main__":
    sys.exit(main())
