"""The thread that owns the port: connects, runs the robot's cycle, and connects again when the link is lost.

    link = Link(settings, sink, clock, report)
    link.connect()            # raises PortError or StartupError: a robot that is not there is an error at the start
    link.start()
    link.post(lambda robot: robot.command(target, 0.2), refused)
    link.close()              # torque off, port closed

A lost link makes the robot limp (by a last word on what is left of it, else by the board's watchdog), and is then
retried with a back-off from 0.6 to 5 s. Nothing here raises into the node's thread after `start`.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

from hexapod_driver import startup
from hexapod_driver.calibration import Calibration
from hexapod_driver.errors import DriverError, LinkLost, PortError, StartupError
from hexapod_driver.one_link import OneLink
from hexapod_driver.readings import Reading
from hexapod_driver.robot import Done, Robot
from hexapod_driver.sensor_board import Identity
from hexapod_driver.serial_port import SerialPort
from hexapod_driver.two_ports import TwoPorts
from hexapod_driver.wire import Wire
from tcbi_contract.safety import CommandRefused, Limits, Safety

FIRST_RETRY_S, LAST_RETRY_S = 0.6, 5.0  # the first lets the board's watchdog act before it is spoken to again

Action = Callable[[Robot], None]
Refused = Callable[[str], None]


@dataclass(frozen=True)
class LinkSettings:
    """Where the robot is and what it may do.

    Attributes:
      port: the sensor board's port if it carries the servo bus, else the servo bus.
      baud_rate: of `port`.
      sensor_port: the sensor board's own port, or empty.
      sensor_baud_rate: of `sensor_port`.
    """

    port: str
    baud_rate: int
    sensor_port: str
    sensor_baud_rate: int
    calibration: Calibration
    limits: Limits = field(default_factory=Limits)


def open_wire(settings: LinkSettings, clock: Callable[[], int]) -> Wire:
    """Open the port or ports for this process alone; nothing is asked yet.

    Raises:
      PortError: a port cannot be opened.
    """
    port = SerialPort(settings.port, settings.baud_rate)
    if not settings.sensor_port:
        return OneLink(port, clock)
    try:
        board = SerialPort(settings.sensor_port, settings.sensor_baud_rate)
    except PortError:
        port.close()
        raise
    return TwoPorts(port, board, clock)


class Link:
    """The robot behind its port, for use from another thread.

    Attributes:
      safety: state of the robot; read it from any thread, change it through `post` only.
      robot: the present connection, None while there is none.
      identity: of the sensor board last seen.
      state: in words, for diagnostics.
      reconnects: how often the link was lost and found again.
    """

    def __init__(
        self,
        settings: LinkSettings,
        sink: Callable[[Reading], None],
        clock: Callable[[], int],
        report: Callable[[str], None],
    ) -> None:
        self.settings = settings
        self.safety = Safety(settings.limits)
        self.robot: Robot | None = None
        self.identity: Identity | None = None
        self.state = "not connected"
        self.reconnects = 0
        self._sink, self._clock, self._report = sink, clock, report
        self._actions: SimpleQueue[tuple[Action, Refused]] = SimpleQueue()
        self._stopping = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def connect(self) -> None:
        """Open the port or ports and check that the whole robot answers.

        Raises:
          PortError: a port cannot be opened.
          StartupError: the board or servos do not answer.
          LinkLost: the port went away meanwhile.
        """
        wire = open_wire(self.settings, self._clock)
        try:
            self.identity = startup.check(wire, self.settings.calibration)
        except BaseException:
            wire.close()
            raise
        wire.wake = self._wake_read  # only now: nobody reads the pipe during the check
        watchdog_ms = round(self.settings.limits.silence_s * 1000)
        self.robot = Robot(wire, self.settings.calibration, self.safety, self._sink, watchdog_ms)
        self.state = "connected"

    def start(self) -> None:
        """Run the cycle in a thread of its own."""
        self._thread.start()

    def post(self, action: Action, refused: Refused) -> None:
        """Have `action` done in the link's thread; `refused` is called there instead when it cannot be."""
        self._actions.put((action, refused))
        self._wake()

    def emergency_stop(self, done: Done) -> None:
        """Make the robot limp until `release`; latched even while the link is down."""

        def unreachable(text: str) -> None:
            self.safety.stop()
            done(False, f"emergency stop stands, but {text}; cut the power to be sure")

        self.post(lambda robot: robot.stop(done), unreachable)

    def release(self, done: Done) -> None:
        """End the emergency stop. The robot stays limp until it is reset."""

        def act(*_: object) -> None:
            stood = self.safety.release()
            text = "released; the robot stays limp until reset_episode" if stood else "no emergency stop stood"
            done(True, text)

        self.post(act, act)

    def close(self) -> None:
        """Take the torque off, close the port, end the thread."""
        self._stopping.set()
        self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)
        else:
            self._shut()

    def _run(self) -> None:
        retry = FIRST_RETRY_S
        try:
            while not self._stopping.is_set():
                if self.robot is not None:
                    retry = FIRST_RETRY_S
                    self._cycle(self.robot)
                elif self._reconnect():
                    self.reconnects += 1
                    self._report("link: found the robot again; it is limp until reset_episode")
                else:
                    self._wait(retry)
                    retry = min(2 * retry, LAST_RETRY_S)
        finally:
            self._shut()

    def _cycle(self, robot: Robot) -> None:
        mode = self.safety.mode
        try:
            robot.receive()
            self._act(robot)
            robot.act()
        except LinkLost as error:
            self._lose(robot, str(error))
        if self.safety.mode is not mode:
            self._report(f"robot is {self.safety.mode.value} {self.safety.reason}".rstrip())

    def _act(self, robot: Robot) -> None:
        self._drain_wake()
        while True:
            try:
                action, refused = self._actions.get_nowait()
            except Empty:
                return
            try:
                action(robot)
            except CommandRefused as error:
                refused(str(error))

    def _lose(self, robot: Robot, reason: str) -> None:
        self.state = f"lost: {reason}"
        self._report(f"link: {reason}; trying to find the robot again")
        self.safety.go_limp(f"link lost: {reason}", needs_reset=True)
        self.robot = None
        with contextlib.suppress(DriverError):  # the port may be the fault
            robot.last_torque_off()
        robot.abandon(reason)
        robot.wire.close()

    def _reconnect(self) -> bool:
        try:
            self.connect()
        except (PortError, StartupError, LinkLost) as error:
            self.state = f"lost: {error}"
            return False
        return True

    def _wait(self, seconds: float) -> None:
        """Wait for the next try, answering meanwhile whoever asks for something."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0 and not self._stopping.is_set():
            try:
                _, refused = self._actions.get(timeout=min(left, 0.1))
            except Empty:
                continue
            refused(f"the robot is not there ({self.state})")

    def _shut(self) -> None:
        robot, self.robot = self.robot, None
        if robot is None:
            return
        self.safety.go_limp("the driver has ended")
        try:
            unsure = robot.torque_off()
            if unsure:
                self._report(f"shutdown: servos {list(unsure)} did not confirm that their torque is off; cut the power")
        except DriverError as error:
            self._report(f"shutdown: {error}; the board's watchdog makes the servos limp")
        finally:
            robot.abandon("the driver is shutting down")
            robot.wire.close()
            self.state = "closed"

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # the pipe is full of wake-ups already
            os.write(self._wake_write, b"!")

    def _drain_wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)
