"""Servo bus and sensor board over one port: servo packets ride inside the board's frames."""

import time
from collections.abc import Callable

from hexapod_driver import sensor_board
from hexapod_driver.feetech import PacketStream
from hexapod_driver.sensor_board import Frame, FrameError, Kind
from hexapod_driver.serial_port import SerialPort
from hexapod_driver.wire import LONGEST_REPLY, BusReply, Request, Wire


class OneLink(Wire):
    """Everything over one port: servo packets ride inside the board's frames.

    Requests do not wait for each other, so that the delay of a radio link costs age, not rate.
    """

    def __init__(self, port: SerialPort, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self._port = port
        self._pending: dict[int, Request] = {}
        port.write(sensor_board.DELIMITER)  # ends whatever half frame the board may still hold

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _board_port(self) -> SerialPort:
        return self._port

    def _submit(self, request: Request) -> None:
        if request.servos:
            request.deadline = time.monotonic() + request.timeout_s
            self._pending[request.tag] = request
        self.send_board(Kind.SERVO, sensor_board.servo_payload(request.tag, len(request.servos), request.packet))

    def _wait(self, timeout_s: float) -> None:
        self.select([self._port], timeout_s)
        self._take_board_bytes(self._port.read())
        now = time.monotonic()
        for tag in [tag for tag, request in self._pending.items() if request.deadline < now]:
            del self._pending[tag]
            self.counters.late_replies += 1
            self.events.append(BusReply(tag, (), self._clock()))

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
        self.events.append(BusReply(reply.tag, tuple(found), self.board_clock.stamp(reply.time_us, arrival)))
