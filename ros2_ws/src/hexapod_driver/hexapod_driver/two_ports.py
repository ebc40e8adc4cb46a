"""Servo bus and sensor board on a port each."""

import time
from collections import deque
from collections.abc import Callable

from hexapod_driver import sensor_board
from hexapod_driver.feetech import PacketStream
from hexapod_driver.serial_port import SerialPort
from hexapod_driver.wire import LONGEST_REPLY, BusReply, Request, Wire


class TwoPorts(Wire):
    """The servo bus bare on one port, the board on another.

    The bus is half duplex: one question at a time. What asks nothing (moves, torque) goes before the questions that
    wait.
    """

    reply_timeout_s = 0.025
    check_timeouts_s = (0.05, 0.2, 0.4)  # one servo after the other
    most_in_flight = 3

    def __init__(self, servo_port: SerialPort, board_port: SerialPort, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self._bus, self._board = servo_port, board_port
        self._packets = PacketStream(LONGEST_REPLY)
        self._queue: deque[Request] = deque()
        self._urgent = 0  # so many at the front of the queue ask nothing
        self._current: Request | None = None
        board_port.write(sensor_board.DELIMITER)

    @property
    def bad_frames(self) -> int:
        """Frames and packets that arrived damaged."""
        return super().bad_frames + self._packets.bad_checksums

    def close(self) -> None:
        """Close both ports."""
        self._bus.close()
        self._board.close()

    def shout(self, packet: bytes) -> None:
        """Send a packet that asks nothing, whatever the bus waits for."""
        self._bus.write(packet)

    def _board_port(self) -> SerialPort:
        return self._board

    def _submit(self, request: Request) -> None:
        if self._current is None:
            self._send(request)
        elif request.servos:
            self._queue.append(request)
        else:
            self._queue.insert(self._urgent, request)
            self._urgent += 1

    def _send(self, request: Request) -> None:
        self._packets.expire()  # whatever is left of an older answer is not ours
        request.sent_ns = self._clock()
        self._bus.write(request.packet)
        if request.servos:
            request.deadline = time.monotonic() + request.timeout_s
            self._current = request

    def _wait(self, timeout_s: float) -> None:
        if self._current is not None:
            timeout_s = min(timeout_s, max(0.0, self._current.deadline - time.monotonic()))
        self.select([self._bus, self._board], timeout_s)
        self._take_board_bytes(self._board.read())
        self._take_bus_bytes(self._bus.read())

    def _take_bus_bytes(self, data: bytes) -> None:
        self.counters.bytes_read += len(data)
        packets = self._packets.feed(data)
        request = self._current
        if request is None:
            return
        request.take(packets)
        late = time.monotonic() > request.deadline
        if late:
            request.take(self._packets.expire())
            self.counters.late_replies += 1
        if late or request.complete:
            middle = (request.sent_ns + self._clock()) // 2
            self.events.append(BusReply(request.tag, tuple(request.packets), middle))
            self._current = None
            while self._queue and self._current is None:
                self._urgent = max(0, self._urgent - 1)
                self._send(self._queue.popleft())
