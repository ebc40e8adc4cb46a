"""The electronics of the emulated robot, byte for byte: 18 STS servos on a bus, and the sensor board.

    electronics = Electronics(body, calibration.load(""), ports=1)
    reply = electronics.receive(0, data)      # bytes from the computer on port 0 -> bytes to send back there
    data = electronics.tick()                 # what the board sends by itself, on electronics.board_port
    electronics.due_in_s()                    # seconds until the next tick has something to say

With one port the board carries the servo bus; with two, port 0 is the bare bus and port 1 the board. Pure: no clock but
the body's own, no port. Servo EEPROM cannot be written, and moves know no acceleration limit.
"""

from collections.abc import Collection

import numpy as np

from hexapod_driver import feetech, sensor_board
from hexapod_driver.calibration import Calibration, JointCalibration
from hexapod_driver.feetech import STEPS_PER_TURN, Instruction, Packet, PacketStream
from hexapod_driver.sensor_board import Feature, Frame, FrameError, FrameStream, Identity, Kind, Sample, ServoReply
from tcbi_bringup.emulated_robot.body import Body, BodyState

MEMORY = 128
FIRMWARE_VERSION = 1
WATCHDOG_S = 0.5  # until a STREAM frame sets another
BOOT_S = 0.3  # from power to a servo's first answer
STREAM_PATIENCE_S = 5.0  # after so long without a word from the computer the board stops its samples
_EEPROM = 40  # registers below cannot be written here
_PRESENT = range(feetech.PRESENT_POSITION, 71)
_OVERHEATED = 1 << 2
_MODEL_STS3215 = 777
_MIN_ANGLE, _MAX_ANGLE, _MAX_TEMPERATURE = 9, 11, 13


class Servo:
    """One servo's memory and what writing into it does to its joint."""

    def __init__(self, index: int, calibration: JointCalibration, body: Body) -> None:
        self._index, self._calibration, self._body = index, calibration, body
        self._waiting: bytes = b""  # a REG_WRITE's address and data until ACTION
        self._moves_until = 0.0
        self._last: tuple[float, int] = (0.0, 0)
        self._memory = bytearray(MEMORY)
        self._put(feetech.MODEL_NUMBER, _MODEL_STS3215)
        self._memory[5] = calibration.servo
        self._put(_MAX_ANGLE, STEPS_PER_TURN - 1)
        self._memory[_MAX_TEMPERATURE] = 70

    @property
    def id(self) -> int:
        """Address on the bus."""
        return self._calibration.servo

    def sense(self, state: BodyState) -> None:
        """Bring the read-only registers up to the body's present."""
        angle = float(state.joint_position[self._index]) / (2 * np.pi) * STEPS_PER_TURN
        joint = self._calibration
        step = min(max(joint.zero_step + joint.direction * round(angle), 0), STEPS_PER_TURN - 1)
        elapsed = state.time_s - self._last[0]
        if elapsed >= 0.01:
            speed = min(max(round((step - self._last[1]) / elapsed), -32767), 32767)
            self._put(feetech.PRESENT_SPEED, feetech.to_sign_magnitude(speed, feetech.SPEED_SIGN))
            self._last = (state.time_s, step)
        load = joint.direction * round(1000 * min(max(float(state.load[self._index]), -1.0), 1.0))
        self._put(feetech.PRESENT_POSITION, step)
        self._put(feetech.PRESENT_LOAD, feetech.to_sign_magnitude(load, feetech.LOAD_SIGN))
        self._memory[feetech.PRESENT_VOLTAGE] = min(max(round(10 * state.voltage), 0), 255)
        self._memory[feetech.PRESENT_TEMPERATURE] = min(max(round(float(state.temperature[self._index])), 0), 255)
        self._memory[feetech.MOVING] = int(state.time_s < self._moves_until)

    def execute(self, packet: Packet, now: float) -> bytes | None:
        """Do what a packet addressed to this servo says; the answer's parameters, None for no answer."""
        params = packet.params
        if packet.code == Instruction.PING:
            return b""
        if packet.code == Instruction.READ and len(params) == 2:
            return self.read(params[0], params[1])
        if packet.code == Instruction.WRITE and params:
            self.write(params[0], params[1:], now)
            return b""
        if packet.code == Instruction.REG_WRITE and params:
            self._waiting = params
            return b""
        if packet.code == Instruction.ACTION:
            waiting, self._waiting = self._waiting, b""
            if waiting:
                self.write(waiting[0], waiting[1:], now)
            return b""
        return None

    def read(self, address: int, length: int) -> bytes:
        """Registers; beyond the memory's end lie zeros."""
        return bytes(self._memory[address : address + length]).ljust(length, b"\0")

    def write(self, address: int, data: bytes, now: float) -> None:
        """Write registers, and act on torque and goal."""
        span = range(address, address + len(data))
        for at, value in zip(span, data, strict=True):
            if _EEPROM <= at < MEMORY and at not in _PRESENT:
                self._memory[at] = value
        if feetech.TORQUE_ENABLE in span:
            self._body.set_torque(self._index, self.torque)
        if feetech.GOAL_POSITION in span and self.torque:
            self._move(now)

    @property
    def torque(self) -> bool:
        """Whether the torque is on."""
        return self._memory[feetech.TORQUE_ENABLE] == 1

    def power_off_torque(self) -> None:
        """What the board's watchdog does."""
        self.write(feetech.TORQUE_ENABLE, b"\0", 0.0)

    def error(self) -> int:
        """The error byte of an answer."""
        hot = self._memory[feetech.PRESENT_TEMPERATURE] >= self._memory[_MAX_TEMPERATURE]
        return _OVERHEATED if hot else 0

    def _move(self, now: float) -> None:
        goal = feetech.from_sign_magnitude(self._get(feetech.GOAL_POSITION), feetech.POSITION_SIGN)
        goal = min(max(goal, self._get(_MIN_ANGLE)), self._get(_MAX_ANGLE))
        duration = self._get(feetech.GOAL_TIME) / 1000
        speed = feetech.from_sign_magnitude(self._get(feetech.GOAL_SPEED), feetech.SPEED_SIGN)
        joint, step_rad = self._calibration, 2 * np.pi / STEPS_PER_TURN
        self._moves_until = now + duration
        goal_rad = joint.direction * (goal - joint.zero_step) * step_rad
        self._body.write_goal(self._index, goal_rad, duration, abs(speed) * step_rad)

    def _put(self, address: int, value: int) -> None:
        self._memory[address : address + 2] = feetech.word(value)

    def _get(self, address: int) -> int:
        return int.from_bytes(self._memory[address : address + 2], "little")


class Present:
    """The body and its latest state, read once for each thing that the electronics do.

    Attributes:
      state: of the last `refresh`.
    """

    def __init__(self, body: Body) -> None:
        self.body = body
        self.state = body.read()

    def refresh(self) -> None:
        """Read the body."""
        self.state = self.body.read()


class ServoBus:
    """All servos on one half-duplex line.

    Attributes:
      absent: ids that do not answer, as if unplugged; may be changed at any time.
    """

    def __init__(self, present: Present, calibration: Calibration, absent: Collection[int] = ()) -> None:
        self.absent = set(absent)
        self._present = present
        joints = calibration.joints.values()
        self._servos = {joint.servo: Servo(index, joint, present.body) for index, joint in enumerate(joints)}
        self._stream = PacketStream()
        self._awake_s = 0.0  # on the body's clock

    def receive(self, data: bytes) -> bytes:
        """Bytes from the line -> what the servos answer."""
        packets = self._stream.feed(data)
        if packets:
            for servo in self._servos.values():
                servo.sense(self._present.state)
        return b"".join(map(self._answer, packets))

    def quiet(self) -> None:
        """The line has been quiet: an unfinished packet is none."""
        self._stream.expire()

    def power_off_torque(self) -> None:
        """Torque off everywhere."""
        for servo in self._servos.values():
            servo.power_off_torque()

    def cut_power(self) -> None:
        """No servo does or answers anything until `restore_power`."""
        self.power_off_torque()
        self._awake_s = np.inf

    def restore_power(self) -> None:
        """The servos start, without torque."""
        if self._awake_s == np.inf:
            self._awake_s = self._present.state.time_s + BOOT_S

    def _answer(self, packet: Packet) -> bytes:
        now = self._present.state.time_s
        if packet.code == Instruction.SYNC_READ:
            return self._sync_read(packet.params)
        if packet.code == Instruction.SYNC_WRITE:
            self._sync_write(packet.params, now)
            return b""
        if packet.id == feetech.BROADCAST:
            for servo in self._there(self._servos):
                servo.execute(packet, now)
            return b""
        return b"".join(self._reply(s, s.execute(packet, now)) for s in self._there([packet.id]))

    def _sync_read(self, params: bytes) -> bytes:
        if len(params) < 3:
            return b""
        address, length, *ids = params
        return b"".join(self._reply(servo, servo.read(address, length)) for servo in self._there(ids))

    def _sync_write(self, params: bytes, now: float) -> None:
        if len(params) < 3 or (len(params) - 2) % (params[1] + 1):
            return
        address, length = params[0], params[1]
        for at in range(2, len(params), length + 1):
            for servo in self._there([params[at]]):
                servo.write(address, params[at + 1 : at + 1 + length], now)

    def _there(self, ids: Collection[int]) -> list[Servo]:
        if self._present.state.time_s < self._awake_s:
            return []
        return [self._servos[i] for i in ids if i in self._servos and i not in self.absent]

    def _reply(self, servo: Servo, params: bytes | None) -> bytes:
        return b"" if params is None else feetech.encode(servo.id, servo.error(), params)


class SensorBoard:
    """The board with IMU and foot switches, which may carry the servo bus too.

    Args:
      carries_bus: whether SERVO frames are forwarded; else the watchdog has the servos' power to cut.
    """

    def __init__(self, present: Present, bus: ServoBus, carries_bus: bool, name: str = "emulated") -> None:
        self._present, self._bus, self._carries_bus, self._name = present, bus, carries_bus, name
        self._stream = FrameStream()
        self._sequence = 0
        self._rate_hz = 0
        self._watchdog_s = WATCHDOG_S
        self._tripped = False
        self._next_sample = 0.0
        self._heard = present.state.time_s
        self._started = 0.0

    def receive(self, data: bytes) -> bytes:
        """Bytes from the computer -> the board's answers."""
        return b"".join(self._answer(frame) for frame in self._stream.feed(data))

    def restart(self) -> None:
        """As if the reset button had been pressed: clock and sequence start again, samples stop."""
        self._started = self._heard = self._present.state.time_s
        self._sequence = self._rate_hz = 0
        self._watchdog_s, self._tripped = WATCHDOG_S, False
        self._bus.restore_power()
        self._stream = FrameStream()

    def tick(self) -> bytes:
        """A sample if one is due; and the watchdog."""
        state = self._present.state
        silence = state.time_s - self._heard
        if silence > self._watchdog_s and not self._tripped:
            self._tripped = True
            if self._carries_bus:
                self._bus.power_off_torque()
            else:
                self._bus.cut_power()
        if silence > STREAM_PATIENCE_S:
            self._rate_hz = 0
        if not self._rate_hz or state.time_s < self._next_sample:
            return b""
        period = 1 / self._rate_hz
        self._next_sample = max(self._next_sample + period, state.time_s - period)
        return self._send(Kind.SAMPLE, sensor_board.sample_payload(self._sample(state)))

    def due_in_s(self) -> float:
        """Seconds of the body's time until the next sample; a watchdog is looked after in between."""
        if not self._rate_hz:
            return 0.02
        return min(max(self._next_sample - self._present.state.time_s, 0.0), 0.02)

    def _sample(self, state: BodyState) -> Sample:
        return Sample(
            self._time_us(state),
            tuple(map(float, state.attitude)),
            tuple(map(float, state.angular_velocity)),
            tuple(map(float, state.linear_acceleration)),
            tuple(map(bool, state.contact)),
            self._tripped,
        )

    def _answer(self, frame: Frame) -> bytes:
        state = self._present.state
        self._heard = state.time_s
        try:
            if frame.kind == Kind.IDENTIFY:
                return self._identify(state)
            if frame.kind == Kind.STREAM:
                self._start_stream(frame, state)
            elif frame.kind == Kind.SERVO and self._carries_bus:
                return self._forward(frame)
            elif frame.kind != Kind.KEEP_ALIVE:
                return self._send(Kind.FAULT, f"kind {frame.kind:#04x} is not known here".encode())
        except FrameError as error:
            return self._send(Kind.FAULT, str(error).encode())
        return b""

    def _start_stream(self, frame: Frame, state: BodyState) -> None:
        rate, watchdog_ms = sensor_board.parse_stream(frame.payload)
        if rate > 0 and not self._rate_hz:
            self._next_sample = state.time_s
        self._rate_hz, self._watchdog_s, self._tripped = rate, watchdog_ms / 1000, False
        self._bus.restore_power()

    def _identify(self, state: BodyState) -> bytes:
        features = Feature.IMU | Feature.FOOT_SWITCHES
        if self._carries_bus:
            features |= Feature.SERVO_BUS
        identity = Identity(sensor_board.VERSION, features, FIRMWARE_VERSION, self._time_us(state), self._name)
        return self._send(Kind.IDENTITY, sensor_board.identity_payload(identity))

    def _forward(self, frame: Frame) -> bytes:
        tag, replies, packet = sensor_board.parse_servo(frame.payload)
        self._bus.quiet()
        data = self._bus.receive(packet)
        if not replies:
            return b""
        stream = PacketStream()
        complete = len(stream.feed(data)) >= replies
        reply = ServoReply(tag, self._time_us(self._present.state), complete, data)
        return self._send(Kind.SERVO_REPLY, sensor_board.servo_reply_payload(reply))

    def _send(self, kind: Kind, payload: bytes) -> bytes:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return sensor_board.encode(Frame(kind, self._sequence, payload))

    def _time_us(self, state: BodyState) -> int:
        return round(1e6 * (state.time_s - self._started))


class Electronics:
    """Servos and board, wired to one port or to two.

    Attributes:
      bus: the servos.
      board: the sensor board.
      ports: 1 or 2.
      board_port: which port the board speaks on.
    """

    def __init__(self, body: Body, calibration: Calibration, ports: int = 1, absent: Collection[int] = ()) -> None:
        if ports not in (1, 2):
            raise ValueError(f"ports of the emulated robot: got {ports}, allowed is 1 or 2")
        self.ports, self.board_port = ports, ports - 1
        self._present = Present(body)
        self.bus = ServoBus(self._present, calibration, absent)
        self.board = SensorBoard(self._present, self.bus, carries_bus=ports == 1)

    def receive(self, port: int, data: bytes) -> bytes:
        """Bytes that came in on `port` -> the answer on the same port."""
        self._present.refresh()
        return self.board.receive(data) if port == self.board_port else self.bus.receive(data)

    def tick(self) -> bytes:
        """What the board sends by itself."""
        self._present.refresh()
        return self.board.tick()

    def due_in_s(self) -> float:
        """How long nothing will happen unless bytes come in."""
        return self.board.due_in_s()
