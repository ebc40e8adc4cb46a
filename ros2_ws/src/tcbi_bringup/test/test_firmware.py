"""The emulated servos, checked over a pseudo-terminal with the servo maker's own client library."""

import select
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import scservo_sdk
import serial

from hexapod_driver import calibration, feetech, sensor_board
from hexapod_driver.sensor_board import Feature, Frame, FrameStream, Kind
from tcbi_bringup.emulated_robot.body import BodyState
from tcbi_bringup.emulated_robot.firmware import Electronics
from tcbi_bringup.emulated_robot.port import PseudoTerminal, serve


class StillBody:
    """Joints that are where they were last told to be, at once; a clock that the test moves."""

    def __init__(self) -> None:
        self.time_s = 1.0
        self.position = np.zeros(18)
        self.torque = [False] * 18
        self.goals: list[tuple[int, float, float, float]] = []

    def write_goal(self, servo_index: int, goal_rad: float, duration_s: float, speed_rad_s: float = 0.0) -> None:
        self.goals.append((servo_index, goal_rad, duration_s, speed_rad_s))
        self.position[servo_index] = goal_rad

    def set_torque(self, servo_index: int, on: bool) -> None:
        self.torque[servo_index] = on

    def read(self) -> BodyState:
        upright = np.array([0.0, 0.0, 0.0, 1.0])
        gravity = np.array([0.0, 0.0, 9.81])
        feet = np.ones(6, bool)
        hot = np.full(18, 30.0)
        return BodyState(
            self.time_s, self.position.copy(), 7.4, hot, np.full(18, -0.25), upright, np.zeros(3), gravity, feet
        )


@pytest.fixture
def body() -> StillBody:
    return StillBody()


@pytest.fixture
def bus_path(body: StillBody) -> Iterator[str]:
    """The bare servo bus of a robot with two ports, servo 18 unplugged."""
    electronics = Electronics(body, calibration.load(""), ports=2, absent={18})
    stop = threading.Event()
    with PseudoTerminal() as bus, PseudoTerminal() as board:
        thread = threading.Thread(target=serve, args=(electronics, [bus, board], stop))
        thread.start()
        yield bus.path
        stop.set()
        thread.join()


@pytest.fixture
def client(bus_path: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple]:
    """The maker's client, patient enough for a busy machine (its own 34 ms are not)."""
    monkeypatch.setattr(scservo_sdk.port_handler, "LATENCY_TIMER", 1000)
    port = scservo_sdk.PortHandler(bus_path)
    assert port.openPort()
    yield port, scservo_sdk.PacketHandler(0)
    port.closePort()


def test_the_makers_client_finds_the_servos_and_misses_the_absent_one(client: tuple):
    port, packets = client
    models = [packets.ping(port, servo) for servo in range(1, 18)]
    assert models == [(777, scservo_sdk.COMM_SUCCESS, 0)] * 17
    assert packets.ping(port, 18)[1] == scservo_sdk.COMM_RX_TIMEOUT


def test_the_makers_client_reads_the_registers(client: tuple, body: StillBody):
    port, packets = client
    body.position[0] = 0.1
    assert packets.read2ByteTxRx(port, 1, 56) == (2048 + 65, 0, 0)
    assert packets.read1ByteTxRx(port, 1, 62)[0] == 74
    assert packets.read1ByteTxRx(port, 1, 63)[0] == 30
    load = packets.read2ByteTxRx(port, 1, 60)[0]
    assert scservo_sdk.SCS_TOHOST(load, 10) == -250


def test_the_makers_client_moves_servos_with_a_sync_write(client: tuple, body: StillBody):
    port, packets = client
    for servo in (1, 10):
        assert packets.write1ByteTxRx(port, servo, 40, 1) == (0, 0)
    write = scservo_sdk.GroupSyncWrite(port, packets, 41, 7)
    for servo in (1, 10):
        assert write.addParam(servo, [0, 0x64, 0x08, 200, 0, 0xF4, 0x01])  # step 2148 in 200 ms, 500 steps/s
    assert write.txPacket() == 0
    deadline = time.monotonic() + 10
    while packets.read2ByteTxRx(port, 1, 56)[0] != 2148:
        assert time.monotonic() < deadline
    step = 2 * np.pi / 4096
    assert body.goals == [
        (0, pytest.approx(100 * step), 0.2, pytest.approx(500 * step)),
        (9, pytest.approx(-100 * step), 0.2, pytest.approx(500 * step)),  # the right side is mirrored
    ]


def test_the_makers_client_reads_positions_with_a_sync_read(client: tuple, body: StillBody):
    port, packets = client
    body.position[:] = np.linspace(-0.5, 0.5, 18)
    reader = scservo_sdk.GroupSyncRead(port, packets, 56, 2)
    for servo in range(1, 18):
        reader.addParam(servo)
    assert reader.txRxPacket() == 0
    robot = calibration.load("")
    found = [reader.getData(servo, 56, 2) for servo in range(1, 18)]
    assert found == [robot.to_step(name, body.position[i]) for i, name in enumerate(list(robot.joints)[:17])]


def test_a_goal_without_torque_moves_nothing_and_reg_write_waits_for_action(client: tuple, body: StillBody):
    port, packets = client
    packets.write2ByteTxRx(port, 2, 42, 2100)
    assert body.goals == []
    packets.write1ByteTxRx(port, 2, 40, 1)
    packets.regWriteTxRx(port, 2, 42, 2, [0x34, 0x08])
    packets.read1ByteTxRx(port, 2, 40)
    assert body.goals == []
    packets.action(port, 0xFE)
    packets.read1ByteTxRx(port, 2, 40)
    assert [goal[0] for goal in body.goals] == [1]


def test_identity_registers_cannot_be_written(client: tuple):
    port, packets = client
    packets.write1ByteTxRx(port, 3, 5, 9)
    assert packets.read1ByteTxRx(port, 3, 5)[0] == 3


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
        ("FF FF 01 04 02 38 02 BE", "FF FF 01 04 00 00 08 F2"),
        ("00 FF 12 FF FF 01 03 FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
    ],
)
def test_the_bytes_are_the_makers(bus_path: str, question: str, answer: str):
    with serial.Serial(bus_path, 1_000_000, timeout=0) as port:
        port.write(bytes.fromhex(question))
        expected, found, deadline = bytes.fromhex(answer), b"", time.monotonic() + 5
        while len(found) < len(expected) and time.monotonic() < deadline:
            select.select([port], [], [], 0.1)
            found += port.read(100)
    assert found == expected


def _frames(data: bytes) -> list[Frame]:
    return FrameStream().feed(data)


def _ask(electronics: Electronics, kind: Kind, payload: bytes = b"") -> list[Frame]:
    return _frames(electronics.receive(electronics.board_port, sensor_board.encode(Frame(kind, 0, payload))))


def test_the_board_says_who_it_is(body: StillBody):
    for ports, bus in ((1, True), (2, False)):
        (frame,) = _ask(Electronics(body, calibration.load(""), ports), Kind.IDENTIFY)
        identity = sensor_board.parse_identity(frame.payload)
        assert bool(identity.features & Feature.SERVO_BUS) is bus
        assert identity.features & Feature.IMU


def test_the_board_carries_servo_packets_with_their_tag(body: StillBody):
    electronics = Electronics(body, calibration.load(""))
    packet = feetech.encode(1, feetech.Instruction.PING)
    (frame,) = _ask(electronics, Kind.SERVO, sensor_board.servo_payload(77, 1, packet))
    reply = sensor_board.parse_servo_reply(frame.payload)
    assert (reply.tag, reply.time_us, reply.complete) == (77, 1_000_000, True)
    assert reply.data == bytes.fromhex("FF FF 01 02 00 FC")
    electronics.bus.absent.add(1)
    (frame,) = _ask(electronics, Kind.SERVO, sensor_board.servo_payload(78, 1, packet))
    assert not sensor_board.parse_servo_reply(frame.payload).complete


def test_the_board_streams_fifty_samples_a_second_of_its_clock(body: StillBody):
    electronics = Electronics(body, calibration.load(""))
    assert electronics.tick() == b""
    _ask(electronics, Kind.STREAM, sensor_board.stream_payload(50, 400))
    stamps = []
    for _ in range(1000):
        body.time_s += 0.001
        _ask(electronics, Kind.KEEP_ALIVE)
        stamps += [sensor_board.parse_sample(f.payload).time_us for f in _frames(electronics.tick())]
    assert len(stamps) == 50
    assert np.all(np.abs(np.diff(stamps) - 20_000) <= 1_000)


def test_the_boards_watchdog_makes_the_servos_limp_and_says_so(body: StillBody):
    electronics = Electronics(body, calibration.load(""))
    _ask(electronics, Kind.STREAM, sensor_board.stream_payload(50, 400))
    _ask(electronics, Kind.SERVO, sensor_board.servo_payload(1, 0, feetech.torque(range(1, 19), True)))
    assert all(body.torque)
    body.time_s += 0.39
    electronics.tick()
    assert all(body.torque)
    body.time_s += 0.02
    (frame,) = _frames(electronics.tick())
    assert not any(body.torque)
    assert sensor_board.parse_sample(frame.payload).watchdog_tripped
    _ask(electronics, Kind.STREAM, sensor_board.stream_payload(50, 400))
    body.time_s += 0.02
    (frame,) = _frames(electronics.tick())
    assert not sensor_board.parse_sample(frame.payload).watchdog_tripped
    assert not any(body.torque)


def test_with_two_ports_the_watchdog_cuts_the_servos_power_until_the_stream_is_asked_for(body: StillBody):
    electronics = Electronics(body, calibration.load(""), ports=2)
    electronics.receive(0, feetech.torque(range(1, 19), True))
    ping = feetech.encode(1, feetech.Instruction.PING)
    assert all(body.torque) and electronics.receive(0, ping)
    body.time_s += 0.6
    electronics.tick()
    assert not any(body.torque) and not electronics.receive(0, ping)
    electronics.receive(1, sensor_board.encode(Frame(Kind.STREAM, 0, sensor_board.stream_payload(0, 500))))
    assert not electronics.receive(0, ping), "it starts"
    body.time_s += 0.35
    electronics.tick()
    assert electronics.receive(0, ping) and not any(body.torque)


def test_the_board_answers_nonsense_with_a_fault(body: StillBody):
    electronics = Electronics(body, calibration.load(""))
    for kind, payload in ((0x55, b""), (Kind.STREAM, b"\1")):
        (frame,) = _frames(electronics.receive(0, sensor_board.encode(Frame(kind, 0, payload))))
        assert frame.kind == Kind.FAULT


def test_three_ports_are_refused(body: StillBody):
    with pytest.raises(ValueError, match="1 or 2"):
        Electronics(body, calibration.load(""), ports=3)
