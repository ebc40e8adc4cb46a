"""Questions and answers on the bare servo bus, where nothing says which belong together."""

import socket
import time
from collections.abc import Iterator

import pytest

from hexapod_driver import feetech
from hexapod_driver.feetech import Packet
from hexapod_driver.two_ports import TwoPorts
from hexapod_driver.wire import BusReply

SERVOS = (1, 2, 3, 4)
QUESTION = feetech.sync_read(SERVOS, feetech.PRESENT_POSITION, 2)
LONG_S = 20.0  # more than any test lasts


class Line:
    """A serial port with the test on its other end."""

    path = "line"

    def __init__(self) -> None:
        self._near, self.far = socket.socketpair()
        self._near.setblocking(False)

    def fileno(self) -> int:
        return self._near.fileno()

    def read(self) -> bytes:
        try:
            return self._near.recv(4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        self._near.send(data)

    def close(self) -> None:
        self._near.close()
        self.far.close()


@pytest.fixture
def bus() -> Line:
    return Line()


@pytest.fixture
def wire(bus: Line) -> Iterator[TwoPorts]:
    wire = TwoPorts(bus, Line(), time.time_ns)
    yield wire
    wire.close()


def answers(*servos: int, value: int = 0) -> bytes:
    return b"".join(feetech.encode(servo, 0, bytes((value, 0))) for servo in servos)


def reply(wire: TwoPorts) -> BusReply:
    """The next answer, or what there is of it in time."""
    events: list = []
    while not events:
        events = wire.poll(LONG_S)
    (event,) = events
    return event


def values(reply: BusReply) -> dict[int, int]:
    return {packet.id: packet.params[0] for packet in reply.packets}


def test_late_answers_are_not_taken_for_those_of_the_next_question(bus, wire):
    wire.submit(QUESTION, SERVOS, timeout_s=1e-3)
    bus.far.send(answers(1, 2, value=1))
    assert values(reply(wire)).keys() <= {1, 2}
    tag = wire.submit(QUESTION, SERVOS, timeout_s=LONG_S)
    bus.far.send(answers(3, 4, value=1) + answers(1, 2, value=2))
    assert wire.poll(0.05) == []
    bus.far.send(answers(3, 4, value=2))
    second = reply(wire)
    assert second.tag == tag and values(second) == dict.fromkeys(SERVOS, 2)


def test_a_servo_that_misses_leaves_a_gap(bus, wire):
    wire.submit(QUESTION, SERVOS, timeout_s=0.2)
    bus.far.send(answers(1, 3, 4, value=1))
    assert list(values(reply(wire))) == [1, 3, 4]


def test_what_another_servo_says_is_no_answer(bus, wire):
    wire.submit(feetech.read(2, feetech.TORQUE_ENABLE, 1), [2], timeout_s=LONG_S)
    bus.far.send(answers(1) + answers(2, value=5))
    assert values(reply(wire)) == {2: 5}


@pytest.mark.parametrize("servos", [SERVOS, (3,)])
def test_an_echo_is_no_answer(bus, wire, servos):
    question = QUESTION if len(servos) > 1 else feetech.read(servos[0], feetech.TORQUE_ENABLE, 1)
    wire.submit(question, servos, timeout_s=LONG_S)
    bus.far.send(question)
    assert wire.poll(0.05) == []
    bus.far.send(b"".join(feetech.encode(servo, 0, b"\x01") for servo in servos))
    assert reply(wire).packets == tuple(Packet(servo, 0, b"\x01") for servo in servos)
