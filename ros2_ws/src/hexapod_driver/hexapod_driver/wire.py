"""The servo bus and the sensor board as one thing, over one port or over two.

`OneLink` (one_link.py): one port to the sensor board, which carries servo packets inside its own frames and puts the
time of the bus on each answer. `TwoPorts` (two_ports.py): the bare servo bus on one port, the board's frames
on the other.

    wire.submit(feetech.sync_read(ids, 56, 2), ids)             # a tag, at once
    for event in wire.poll(0.005):                              # BusReply and BoardFrame, as they come
        ...
    packets = wire.transact(feetech.read(1, 56, 2), [1], timeout_s=0.1)

Time: `clock` gives the node's ROS clock in ns; `time.monotonic` decides about deadlines. Every failure of a port comes
out as `LinkLost`.
"""

import select
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hexapod_driver import feetech, sensor_board
from hexapod_driver.clock import BoardClock
from hexapod_driver.errors import LinkLost
from hexapod_driver.feetech import Packet
from hexapod_driver.sensor_board import Frame, FrameStream, Kind
from hexapod_driver.serial_port import SerialPort
from hexapod_driver.timer import Timer

KEEP_ALIVE_S = 0.1  # between two words to the board, whose watchdog else acts
LONGEST_REPLY = 32  # LEN of the longest answer this driver asks a servo for


@dataclass(frozen=True)
class BusReply:
    """The answers to one request on the servo bus.

    Attributes:
      tag: what `submit` returned.
      packets: the servos' answers, in the order they came; fewer than asked for where a servo was silent.
      stamp_ns: ROS time at which the servos answered.
    """

    tag: int
    packets: tuple[Packet, ...]
    stamp_ns: int


@dataclass(frozen=True)
class BoardFrame:
    """A frame of the sensor board and when it arrived on the ROS clock."""

    frame: Frame
    arrival_ns: int


@dataclass
class Counters:
    """What went wrong on the wire since it was opened."""

    bytes_read: int = 0
    lost_samples: int = 0
    late_replies: int = 0
    bad_payloads: int = 0


@dataclass
class Request:
    """A packet on its way to the servo bus, and the answers so far."""

    tag: int
    packet: bytes
    servos: tuple[int, ...]  # that answer, in this order
    timeout_s: float
    deadline: float = 0.0
    sent_ns: int = 0  # ROS clock
    packets: list[Packet] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether every servo has answered."""
        return len(self.packets) == len(self.servos)

    def take(self, packets: Iterable[Packet]) -> None:
        """Collect answers from a bus that does not say whose they are.

        Packets of servos that were not asked are dropped, and so is the question itself, which some adapters echo.
        Where the order goes back, the answers before were late ones to another question.
        """
        for packet in packets:
            if packet.id not in self.servos or feetech.encode(packet.id, packet.code, packet.params) == self.packet:
                continue
            if self.packets and self.servos.index(packet.id) <= self.servos.index(self.packets[-1].id):
                self.packets.clear()
            self.packets.append(packet)


Event = BusReply | BoardFrame


class Wire(ABC):
    """What `OneLink` and `TwoPorts` share: tags, events, sequence numbers, the board's frames.

    Attributes:
      board_clock: maps the board's time onto the ROS clock.
      counters: faults so far.
      wake: read end of a pipe; a byte in it ends a `poll` early, until it is read.
    """

    reply_timeout_s = 0.3
    check_timeouts_s = (0.5, 1.0, 1.0)  # of each round of the start-up check; a busy machine may be slow to answer
    most_in_flight = 18  # questions that may wait for their answers at once

    def __init__(self, clock: Callable[[], int]) -> None:
        self.board_clock = BoardClock()
        self.counters = Counters()
        self.frames = FrameStream()
        self.wake: int | None = None
        self._clock = clock
        self.events: deque[Event] = deque()
        self._tag = 0
        self._sequence = 0
        self._board_sequence: int | None = None

    @property
    def bad_frames(self) -> int:
        """Frames and packets that arrived damaged."""
        return self.frames.bad + self.counters.bad_payloads

    def age_s(self, stamp_ns: int) -> float:
        """How long ago a stamp was, by the ROS clock; never negative."""
        return max(0, self._clock() - stamp_ns) * 1e-9

    def submit(self, packet: bytes, servos: Sequence[int] = (), timeout_s: float | None = None) -> int:
        """Send a packet to the servo bus.

        Args:
          servos: ids that will answer, in this order; a `BusReply` follows if there are any.
          timeout_s: how long to wait for them; `reply_timeout_s` if not given.
        """
        self._tag = (self._tag + 1) & 0xFFFF
        self._submit(Request(self._tag, packet, tuple(servos), timeout_s or self.reply_timeout_s))
        return self._tag

    def shout(self, packet: bytes) -> None:
        """Send a packet that asks nothing, also where the answers to another are still awaited, which it may spoil."""
        self.submit(packet)

    def send_board(self, kind: Kind, payload: bytes = b"") -> None:
        """Send a frame to the sensor board."""
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._board_port().write(sensor_board.encode(Frame(kind, self._sequence, payload)))

    def poll(self, timeout_s: float) -> list[Event]:
        """Wait for something to arrive, `timeout_s` at most, and return what did."""
        if not self.events:
            self._wait(timeout_s)
        events = list(self.events)
        self.events.clear()
        return events

    def gather(self, tags: Collection[int], timeout_s: float) -> dict[int, tuple[Packet, ...]]:
        """Wait for the answers to several requests, by tag; none after `timeout_s`. Board frames wait their turn."""
        now = time.monotonic()
        deadline, alive = now + timeout_s, Timer(KEEP_ALIVE_S, now)
        kept: list[Event] = []
        found: dict[int, tuple[Packet, ...]] = {}
        while len(found) < len(tags) and (left := deadline - (now := time.monotonic())) > 0:
            if alive.due(now):
                self.send_board(Kind.KEEP_ALIVE)
            for event in self.poll(min(left, alive.left(now))):
                if not isinstance(event, BusReply):
                    kept.append(event)
                elif event.tag in tags:
                    found[event.tag] = event.packets
        self.events.extendleft(reversed(kept))
        return found

    def transact(self, packet: bytes, servos: Sequence[int], timeout_s: float) -> tuple[Packet, ...]:
        """Send one packet and wait for the answers of `servos`; fewer after `timeout_s`."""
        tag = self.submit(packet, servos)
        return self.gather((tag,), timeout_s).get(tag, ())

    def ask_board(self, kind: Kind, payload: bytes, answer: Kind, timeout_s: float) -> Frame | None:
        """Send a frame to the board and wait for a frame of the kind `answer`."""
        self.send_board(kind, payload)
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            for event in self.poll(left):
                if isinstance(event, BoardFrame) and event.frame.kind == answer:
                    return event.frame
        return None

    @abstractmethod
    def close(self) -> None:
        """Close every port."""

    @abstractmethod
    def _submit(self, request: Request) -> None: ...

    @abstractmethod
    def _wait(self, timeout_s: float) -> None: ...

    @abstractmethod
    def _board_port(self) -> SerialPort: ...

    def _take_board_bytes(self, data: bytes) -> None:
        self.counters.bytes_read += len(data)
        arrival = self._clock()
        for frame in self.frames.feed(data):
            self._count_gap(frame)
            self._take_frame(frame, arrival)

    def _take_frame(self, frame: Frame, arrival: int) -> None:
        self.events.append(BoardFrame(frame, arrival))

    def select(self, ports: list[SerialPort], timeout_s: float) -> None:
        try:
            sources: list[Any] = [*ports] if self.wake is None else [*ports, self.wake]
            select.select(sources, [], [], max(0.0, timeout_s))
        except (OSError, ValueError) as error:
            raise LinkLost(f"port {' or '.join(port.path for port in ports)} went away ({error})") from error

    def _count_gap(self, frame: Frame) -> None:
        if self._board_sequence is not None:
            gap = (frame.sequence - self._board_sequence - 1) & 0xFFFF
            if gap < 1000:  # more is a board that was restarted, not a loss
                self.counters.lost_samples += gap
        self._board_sequence = frame.sequence
