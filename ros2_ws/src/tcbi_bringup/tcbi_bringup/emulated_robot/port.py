"""Pseudo-terminals for the emulated robot: the computer's side is a serial port like any other.

with PseudoTerminal() as terminal:
    print(terminal.path)                     # give this to driver_node as its port
    serve(electronics, [terminal], stop)     # until `stop` is set
"""

import contextlib
import errno
import os
import select
import threading
import tty
from collections.abc import Sequence
from pathlib import Path

from tcbi_bringup.emulated_robot.firmware import Electronics

LONGEST_WAIT_S = 0.02


class PseudoTerminal:
    """One pseudo-terminal in raw mode.

    The robot's side keeps the computer's side open too, so that computers may come and go as they do on a radio
    link. What nobody reads is dropped, as a radio would.

    Attributes:
      path: what the computer opens; the link if one was asked for.
    """

    def __init__(self, link: Path | None = None) -> None:
        """Make a terminal, and a symbolic link to it if `link` is given (an old link there is replaced)."""
        self._robot, self._computer = os.openpty()
        tty.setraw(self._robot)
        tty.setraw(self._computer)
        os.set_blocking(self._robot, False)
        device = os.ttyname(self._computer)
        self._link = link
        self.path = device
        if link is not None:
            fresh = link.with_name(f".{link.name}.{os.getpid()}")
            fresh.symlink_to(device)
            fresh.replace(link)
            self.path = str(link)

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._robot < 0

    def fileno(self) -> int:
        """The robot's side, for `select`."""
        return self._robot

    def read(self) -> bytes:
        """What the computer has sent, perhaps nothing."""
        try:
            return os.read(self._robot, 65536)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:  # every computer has closed its side
                return b""
            raise

    def write(self, data: bytes) -> None:
        """Send to the computer what its buffer takes."""
        if data:
            with contextlib.suppress(BlockingIOError):
                os.write(self._robot, data)

    def close(self) -> None:
        """Pull the plug: whoever has the port open gets an I/O error."""
        if self.closed:
            return
        os.close(self._robot)
        os.close(self._computer)
        self._robot = -1
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def __enter__(self) -> "PseudoTerminal":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(electronics: Electronics, terminals: Sequence[PseudoTerminal], stop: threading.Event) -> None:
    """Run the electronics behind their terminals until `stop` is set; all in the calling thread.

    Args:
      terminals: as many as the electronics have ports, in their order.
    """
    while not stop.is_set():
        exchange(electronics, terminals, min(electronics.due_in_s(), LONGEST_WAIT_S))


def exchange(electronics: Electronics, terminals: Sequence[PseudoTerminal], wait_s: float) -> None:
    """Wait for bytes, `wait_s` at most, answer them, and send what the board has to say by itself."""
    ready, _, _ = select.select(terminals, [], [], wait_s)
    for port, terminal in enumerate(terminals):
        if terminal in ready:
            terminal.write(electronics.receive(port, terminal.read()))
    terminals[electronics.board_port].write(electronics.tick())
