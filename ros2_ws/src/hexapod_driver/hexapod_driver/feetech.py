"""Packets of Feetech's STS serial servos: encoding, a stream parser that outlives rubbish, the registers in use.

A packet is `FF FF ID LEN CODE params ~SUM`; CODE is an instruction on the way out and an error byte on the way
back, LEN counts CODE, the parameters and the checksum. Words are little-endian. Signed registers carry the sign in one
bit and the magnitude in the rest (they are not two's complement).

    encode(1, Instruction.PING)                        # FF FF 01 02 01 FB
    sync_read([1, 2], PRESENT_POSITION, 2)             # every servo answers with a packet of its own, in this order
    stream = PacketStream(); stream.feed(data)         # the packets that are whole by now

Source: Feetech, "FT-SCS communication protocol manual" and "STS series memory table".
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

STEPS_PER_TURN = 4096
BROADCAST = 0xFE
MAX_ID = 0xFC  # 253 is unused, 254 is the broadcast, 255 cannot be told from a header
MAX_LENGTH = 250  # greatest LEN that the maker's own library accepts

MODEL_NUMBER, TORQUE_ENABLE, ACCELERATION = 3, 40, 41
GOAL_POSITION, GOAL_TIME, GOAL_SPEED = 42, 44, 46
PRESENT_POSITION, PRESENT_SPEED, PRESENT_LOAD = 56, 58, 60
PRESENT_VOLTAGE, PRESENT_TEMPERATURE, MOVING, PRESENT_CURRENT = 62, 63, 66, 69

POSITION_SIGN, SPEED_SIGN, LOAD_SIGN = 15, 15, 10  # which bit is the sign

_HEADER = b"\xff\xff"
_ERROR_NAMES = {0: "voltage", 1: "angle sensor", 2: "overheated", 3: "overcurrent", 5: "overload"}


class Instruction(IntEnum):
    """What a packet asks of a servo."""

    PING = 1
    READ = 2
    WRITE = 3
    REG_WRITE = 4
    ACTION = 5
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True)
class Packet:
    """One packet: the servo's id, the instruction or error byte, the parameters."""

    id: int
    code: int
    params: bytes = b""


@dataclass(frozen=True)
class TimedMove:
    """A linear move of one servo.

    Attributes:
      step: goal, 0 to 4095.
      time_ms: duration of the move; 0 lets the speed decide.
      speed: steps/s; servos whose firmware takes no time go by this; 0 is as fast as the servo can.
      acceleration: 100 steps/s^2; 0 is without limit, as a linear ramp needs.
    """

    step: int
    time_ms: int
    speed: int
    acceleration: int = 0


def checksum(body: bytes | bytearray) -> int:
    """Checksum of ID, LEN, CODE and parameters."""
    return ~sum(body) & 0xFF


def encode(servo: int, code: int, params: bytes = b"") -> bytes:
    """One packet as bytes.

    Raises:
      ValueError: the id is none, or the packet would be longer than a servo takes.
    """
    if not (0 <= servo <= MAX_ID or servo == BROADCAST):
        raise ValueError(f"servo id: got {servo}, allowed is 0 to {MAX_ID} or {BROADCAST}")
    if len(params) + 2 > MAX_LENGTH:
        raise ValueError(f"packet parameters: got {len(params)} bytes, allowed is up to {MAX_LENGTH - 2}")
    body = bytes((servo, len(params) + 2, code)) + params
    return _HEADER + body + bytes((checksum(body),))


def read(servo: int, address: int, length: int) -> bytes:
    """Ask one servo for `length` bytes of its memory."""
    return encode(servo, Instruction.READ, bytes((address, length)))


def write(servo: int, address: int, data: bytes) -> bytes:
    """Write into one servo's memory."""
    return encode(servo, Instruction.WRITE, bytes((address,)) + data)


def sync_read(servos: Iterable[int], address: int, length: int) -> bytes:
    """Ask many servos for the same registers at once."""
    return encode(BROADCAST, Instruction.SYNC_READ, bytes((address, length, *servos)))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Write the same registers of many servos at once; no servo answers.

    Args:
      data: servo id to bytes, all of one length.
    """
    lengths = {len(d) for d in data.values()}
    if len(lengths) != 1:
        raise ValueError(f"sync write: got data of lengths {sorted(lengths)}, allowed is one length")
    body = b"".join(bytes((servo,)) + d for servo, d in data.items())
    return encode(BROADCAST, Instruction.SYNC_WRITE, bytes((address, lengths.pop())) + body)


def timed_moves(moves: Mapping[int, TimedMove]) -> bytes:
    """One sync write that starts the moves of many servos together."""
    return sync_write(ACCELERATION, {servo: _move_bytes(move) for servo, move in moves.items()})


def torque(servos: Sequence[int], on: bool) -> bytes:
    """One sync write that switches the torque of many servos."""
    return sync_write(TORQUE_ENABLE, {servo: bytes((int(on),)) for servo in servos})


def _move_bytes(move: TimedMove) -> bytes:
    words = (to_sign_magnitude(move.step, POSITION_SIGN), move.time_ms, to_sign_magnitude(move.speed, SPEED_SIGN))
    return bytes((move.acceleration,)) + b"".join(word(w) for w in words)


def word(value: int) -> bytes:
    """A 16-bit register's bytes."""
    return value.to_bytes(2, "little")


def to_sign_magnitude(value: int, bit: int) -> int:
    """A signed register: magnitude below `bit`, the sign in it."""
    if abs(value) >= 1 << bit:
        raise ValueError(f"register value: got {value}, allowed is less than {1 << bit} either side of zero")
    return abs(value) | (1 << bit if value < 0 else 0)


def from_sign_magnitude(raw: int, bit: int) -> int:
    """The value of a signed register."""
    magnitude = raw & ((1 << bit) - 1)
    return -magnitude if raw >> bit & 1 else magnitude


def error_names(code: int) -> tuple[str, ...]:
    """What a servo's error byte complains of."""
    return tuple(_ERROR_NAMES.get(bit, f"bit {bit}") for bit in range(8) if code >> bit & 1)


class PacketStream:
    """Finds packets in a stream of bytes, whatever lies between them.

    The packets found do not depend on how the stream is cut into pieces. A header with a wrong checksum or an
    impossible length costs one byte, and the search goes on behind it. A header whose length is a lie makes the
    stream wait for bytes that never come; `expire`, called when the line has been quiet, gives up on it.

    Attributes:
      rubbish: bytes that belonged to no packet so far.
      bad_checksums: headers dropped for their checksum.
    """

    def __init__(self, longest: int = MAX_LENGTH) -> None:
        self.rubbish = 0
        self.bad_checksums = 0
        self._longest = longest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes, return the packets that are whole now."""
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def expire(self) -> list[Packet]:
        """Give up on the unfinished packet at the front and return whatever was hidden behind it."""
        packets: list[Packet] = []
        while self._buffer:
            self._drop(1)
            packets += self.feed(b"")
        return packets

    def _next(self) -> Packet | None:
        while self._seek_header():
            length = self._buffer[3]
            if not 2 <= length <= self._longest:
                self._drop(1)
                continue
            end = 4 + length
            if len(self._buffer) < end:
                return None
            if checksum(self._buffer[2 : end - 1]) != self._buffer[end - 1]:
                self.bad_checksums += 1
                self._drop(1)
                continue
            packet = Packet(self._buffer[2], self._buffer[4], bytes(self._buffer[5 : end - 1]))
            del self._buffer[:end]
            return packet
        return None

    def _seek_header(self) -> bool:
        """Bring a header to the front; False where more bytes are needed to see one."""
        while True:
            at = self._buffer.find(_HEADER)
            if at < 0:
                self._drop(len(self._buffer) - self._buffer.endswith(b"\xff"))
                return False
            self._drop(at)
            if len(self._buffer) < 4:
                return False
            if self._buffer[2] != 0xFF:
                return True
            self._drop(1)

    def _drop(self, count: int) -> None:
        self.rubbish += count
        del self._buffer[:count]
