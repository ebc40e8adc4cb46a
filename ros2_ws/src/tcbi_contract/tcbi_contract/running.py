"""How every node process starts and ends; needs ROS.

def main(args=None) -> int:
    return run("sim_node", SimNode, args)

Exit status: 0 on Ctrl-C or SIGTERM; 1 with one line where a user can mend it (set up wrongly, a device that is not
there); CRASHED with a traceback on any other exception, so that the launcher tells a crash from a wrong set-up.

rclpy's own handlers shut the context down from another thread, in the midst of what the executor does, which at times
ends in one of rclpy's errors, or never. Here a signal only ends the spinning: the callback in hand is finished,
then the node's `leave`, if it has one, ends what is its own (a port, a bag, a worker), the node is destroyed and the
context shut down, in this order and in one thread. Of an executor with several threads, a callback may go on meanwhile:
`leave` asks it to end. A node that hangs says where. If it is the middleware that hangs, after all that is the node's
own has ended, the process ends with the status that it would have had.
"""

import faulthandler
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidParameterException, InvalidParameterValueException
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from tcbi_contract.errors import TcbiError
from tcbi_contract.forced_exit import forced_exit

CRASHED = os.EX_SOFTWARE  # 70
SIGNALS = (signal.SIGINT, signal.SIGTERM)
EVENTS_S = 0.5  # between two looks at the events of a node's topics
LOOK_S = 0.005
ENDING_S = 10.0  # what still runs so long after a signal tells on stderr where it hangs, and ends with status 1
PARTING_S = 4.0  # for the middleware to let go of a node that has ended


def run(name: str, make: Callable[[], Node], args: Sequence[str] | None = None, threads: int = 1) -> int:
    """Make a node and spin it until the process is told to end.

    Args:
      name: what the process is called in its error line.
      make: builds the node; a TcbiError from it, or from a callback later, ends the process with status 1.
      args: command line; None for the process's own.
      threads: of the executor; more than one only for nodes whose actions need it.

    Returns:
      The exit status.
    """
    told = Told()
    nodes: list[Node] = []

    def spin() -> None:
        rclpy.init(args=None if args is None else list(args), signal_handler_options=SignalHandlerOptions.NO)
        nodes.append(make())
        heed_events_seldom(nodes[0])
        executor = SingleThreadedExecutor() if threads == 1 else MultiThreadedExecutor(num_threads=threads)
        executor.add_node(nodes[0])
        told.interrupts(nodes[0])
        while not told.to_end:
            executor.spin_once()

    def leave() -> None:
        for node in nodes:
            if hasattr(node, "leave"):
                node.leave()

    def part() -> None:
        try:
            for node in nodes:
                node.destroy_node()
        finally:
            rclpy.try_shutdown()

    status = 0
    try:
        status = guarded(name, spin)
    finally:  # also of SystemExit
        status = guarded(name, leave) or status
        told.parts()
        with forced_exit(PARTING_S, status):
            parted = guarded(name, part)
        faulthandler.cancel_dump_traceback_later()
    return status or parted


def guarded(name: str, part: Callable[[], None]) -> int:
    """Do a part of a process; returns the exit status, having said on stderr what went wrong."""
    try:
        part()
    except (TcbiError, InvalidParameterException, InvalidParameterValueException) as error:
        sys.stderr.write(f"{name}: {' '.join(str(error).split())}\n")
        return 1
    except Exception:  # noqa: BLE001 - nothing is hidden: the process ends with its traceback
        traceback.print_exc()
        return CRASHED
    return 0


class Seldom(CallbackGroup):
    """Lets what is in it be executed for a moment, twice a second."""

    def __init__(self) -> None:
        super().__init__()
        self._until = 0.0

    def can_execute(self, entity: Any) -> bool:
        """Whether this is such a moment."""
        now = time.monotonic()
        if now - self._until > EVENTS_S:
            self._until = now + LOOK_S
        return now < self._until

    def beginning_execution(self, entity: Any) -> bool:
        """It has been waited for, so that it may be told."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Nothing to do."""


def heed_events_seldom(node: Node) -> None:
    """Look now and then at the events of a node's topics (a profile that does not fit), not at each of its wakings.

    Every publisher and subscription has two, and rclpy builds its wait set anew for every message: they are a fifth of
    what a node that is woken a hundred times a second costs.
    """
    seldom = Seldom()
    topics: list[Any] = [*node.publishers, *node.subscriptions]
    for topic in topics:
        for handler in topic.event_handlers:
            handler.callback_group = seldom


class Told:
    """Whether SIGINT or SIGTERM has come; ends the wait of a node's executor.

    Attributes:
      to_end: one has come.
    """

    def __init__(self) -> None:
        self.to_end = self._parting = False
        self._watching = threading.Lock()
        self._guard: GuardCondition | None = None
        heard, self._heard = os.pipe()
        os.set_blocking(self._heard, False)
        for number in SIGNALS:
            signal.signal(number, lambda *_: None)  # what Python calls late, once the wait is over
        signal.set_wakeup_fd(self._heard, warn_on_full_buffer=False)  # what the interpreter writes to at once
        threading.Thread(target=self._listen, args=(heard,), name="signals", daemon=True).start()

    def interrupts(self, node: Node) -> None:
        """Name the node whose executor waits."""
        self._guard = node.create_guard_condition(lambda: None, callback_group=ReentrantCallbackGroup())

    def parts(self) -> None:
        """All that is the node's own has ended: what still hangs tells where, in place of ending the process."""
        with self._watching:
            self._parting = True
            faulthandler.dump_traceback_later(0.75 * PARTING_S)

    def _listen(self, heard: int) -> None:
        while os.read(heard, 1)[0] not in SIGNALS:
            pass
        with self._watching:
            if not self._parting:
                faulthandler.dump_traceback_later(ENDING_S, exit=True)
        self.to_end = True
        if self._guard is not None:
            self._guard.trigger()
