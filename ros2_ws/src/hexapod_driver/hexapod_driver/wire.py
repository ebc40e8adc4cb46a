"""The servo bus and the sensor board as one thing, over one port or over two.

`OneLink`: one port to the sensor board, which carries servo packets inside its own frames and puts the time of the
bus on each answer. `TwoPorts`: the bare servo bus on one port, the board's frames on the other.

    wire.submit(feetech.sync_read(ids, 56, 2), replies=18)      # a tag, at once
    for event in wire.poll(0.005):                              # BusReply and BoardFrame, as they come
        ...
    reply = wire.transact(feetech.encode(1, Instruction.PING), replies=1, timeout_s=0.1)

Time: `clock` gives the node's ROS clock in ns; `time.monotonic` decides about deadlines. A byte in the pipe `wake` ends
a `poll` early. Every failure of a port comes out as `LinkLost`.
"""

import select
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from hexapod_driver import sensor_board
from hexapod_driver.clock import BoardClock
from hexapod_driver.errors import LinkLost
from hexapod_driver.feetech import Packet, PacketStream
from hexapod_driver.sensor_board import Frame, FrameError, FrameStream, Kind
from hexapod_driver.serial_port import SerialPort

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
class _Request:
    tag: int
    packet: bytes
    replies: int
    deadline: float = 0.0
    sent_ns: int = 0  # ROS clock
    packets: list[Packet] = field(default_factory=list)


Event = BusReply | BoardFrame


class Wire(ABC):
    """What `OneLink` and `TwoPorts` share: tags, events, sequence numbers, the board's frames.

    Attributes:
      board_clock: maps the board's time onto the ROS clock.
      counters: faults so far.
    """

    reply_timeout_s = 0.1
    most_in_flight = 10  # questions that may wait for their answers at once

    def __init__(self, clock: Callable[[], int], wake: int | None) -> None:
        self.board_clock = BoardClock()
        self.counters = Counters()
        self.frames = FrameStream()
        self._clock = clock
        self._wake = [] if wake is None else [wake]
        self._events: deque[Event] = deque()
        self._tag = 0
        self._sequence = 0
        self._board_sequence: int | None = None

    @property
    def bad_frames(self) -> int:
        """Frames and packets that arrived damaged."""
        return self.frames.bad + self.counters.bad_payloads

    def submit(self, packet: bytes, replies: int = 0) -> int:
        """Send a packet to the servo bus.

        Args:
          replies: how many servos will answer; a `BusReply` follows if there are any.
        """
        self._tag = (self._tag + 1) & 0xFFFF
        self._submit(_Request(self._tag, packet, replies))
        return self._tag

    def send_board(self, kind: Kind, payload: bytes = b"") -> None:
        """Send a frame to the sensor board."""
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._board_port().write(sensor_board.encode(Frame(kind, self._sequence, payload)))

    def poll(self, timeout_s: float) -> list[Event]:
        """Wait for something to arrive, `timeout_s` at most, and return what did."""
        if not self._events:
            self._wait(timeout_s)
        events = list(self._events)
        self._events.clear()
        return events

    def gather(self, tags: Collection[int], timeout_s: float) -> dict[int, tuple[Packet, ...]]:
        """Wait for the answers to several requests, by tag; none after `timeout_s`. Board frames wait their turn."""
        deadline = time.monotonic() + timeout_s
        kept: list[Event] = []
        found: dict[int, tuple[Packet, ...]] = {}
        while len(found) < len(tags) and (left := deadline - time.monotonic()) > 0:
            for event in self.poll(left):
                if not isinstance(event, BusReply):
                    kept.append(event)
                elif event.tag in tags:
                    found[event.tag] = event.packets
        self._events.extendleft(reversed(kept))
        return found

    def transact(self, packet: bytes, replies: int, timeout_s: float) -> tuple[Packet, ...]:
        """Send one packet and wait for its answers; fewer than `replies` after `timeout_s`."""
        tag = self.submit(packet, replies)
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
    def _submit(self, request: _Request) -> None: ...

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
        self._events.append(BoardFrame(frame, arrival))

    def _select(self, ports: list[SerialPort], timeout_s: float) -> None:
        try:
            sources: list[Any] = [*ports, *self._wake]
            select.select(sources, [], [], max(0.0, timeout_s))
        except (OSError, ValueError) as error:
            raise LinkLost(f"port {' or '.join(port.path for port in ports)} went away ({error})") from error

    def _count_gap(self, frame: Frame) -> None:
        if self._board_sequence is not None:
            gap = (frame.sequence - self._board_sequence - 1) & 0xFFFF
            if gap < 1000:  # more is a board that was restarted, not a loss
                self.counters.lost_samples += gap
        self._board_sequence = frame.sequence


class OneLink(Wire):
    """Everything over one port: servo packets ride inside the board's frames.

    Requests do not wait for each other, so that the delay of a radio link costs age, not rate.
    """

    def __init__(self, port: SerialPort, clock: Callable[[], int], wake: int | None = None) -> None:
        super().__init__(clock, wake)
        self._port = port
        self._pending: dict[int, _Request] = {}
        port.write(sensor_board.DELIMITER)  # ends whatever half frame the board may still hold

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _board_port(self) -> SerialPort:
        return self._port

    def _submit(self, request: _Request) -> None:
        if request.replies:
            request.deadline = time.monotonic() + self.reply_timeout_s
            self._pending[request.tag] = request
        self.send_board(Kind.SERVO, sensor_board.servo_payload(request.tag, request.replies, request.packet))

    def _wait(self, timeout_s: float) -> None:
        self._select([self._port], timeout_s)
        self._take_board_bytes(self._port.read())
        now = time.monotonic()
        for tag in [tag for tag, request in self._pending.items() if request.deadline < now]:
            del self._pending[tag]
            self.counters.late_replies += 1
            self._events.append(BusReply(tag, (), self._clock()))

    def _take_frame(self, frame: Frame, arrival: int) -> None:
        if frame.kind != Kind.SERVO_REPLY:
            super()._take_frame(frame, arrival)
            return
        try:
            reply = sensor_board.parse_servo_reply(frame.payload)
        except FrameError:
            self.counters.bad_payloads += 1
            return
        self.board_clock.observe(reply.time_us, arrival)
        if self._pending.pop(reply.tag, None) is None:
            return  # given up on before
        packets = PacketStream(LONGEST_REPLY)
        found = packets.feed(reply.data) + packets.expire()
        self._events.append(BusReply(reply.tag, tuple(found), self.board_clock.stamp(reply.time_us, arrival)))


class TwoPorts(Wire):
    """The servo bus bare on one port, the board on another.

    The bus is half duplex: one question at a time. What asks nothing (moves, torque) goes before the questions that
    wait.
    """

    reply_timeout_s = 0.025
    most_in_flight = 3

    def __init__(
        self, servo_port: SerialPort, board_port: SerialPort, clock: Callable[[], int], wake: int | None = None
    ) -> None:
        super().__init__(clock, wake)
        self._bus, self._board = servo_port, board_port
        self._packets = PacketStream(LONGEST_REPLY)
        self._queue: deque[_Request] = deque()
        self._urgent = 0  # so many at the front of the queue ask nothing
        self._current: _Request | None = None
        board_port.write(sensor_board.DELIMITER)

    @property
    def bad_frames(self) -> int:
        """Frames and packets that arrived damaged."""
        return super().bad_frames + self._packets.bad_checksums

    def close(self) -> None:
        """Close both ports."""
        self._bus.close()
        self._board.close()

    def _board_port(self) -> SerialPort:
        return self._board

    def _submit(self, request: _Request) -> None:
        if self._current is None:
            self._send(request)
        elif request.replies:
            self._queue.append(request)
        else:
            self._queue.insert(self._urgent, request)
            self._urgent += 1

    def _send(self, request: _Request) -> None:
        self._packets.expire()  # whatever is left of an older answer is not ours
        request.sent_ns = self._clock()
        self._bus.write(request.packet)
        if request.replies:
            request.deadline = time.monotonic() + self.reply_timeout_s
            self._current = request

    def _wait(self, timeout_s: float) -> None:
        if self._current is not None:
            timeout_s = min(timeout_s, max(0.0, self._current.deadline - time.monotonic()))
        self._select([self._bus, self._board], timeout_s)
        self._take_board_bytes(self._board.read())
        self._take_bus_bytes(self._bus.read())

    def _take_bus_bytes(self, data: bytes) -> None:
        self.counters.bytes_read += len(data)
        packets = self._packets.feed(data)
        request = self._current
        if request is None:
            return
        request.packets += packets
        late = time.monotonic() > request.deadline
        if late:
            request.packets += self._packets.expire()
            self.counters.late_replies += 1
        if late or len(request.packets) >= request.replies:
            middle = (request.sent_ns + self._clock()) // 2
            self._events.append(BusReply(request.tag, tuple(request.packets), middle))
            self._current = None
            while self._queue and self._current is None:
                self._urgent = max(0, self._urgent - 1)
                self._send(self._queue.popleft())
