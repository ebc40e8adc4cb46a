"""The sensor board's framed protocol, version 1; docs/protocol.md describes it byte by byte.

A frame is COBS-encoded and ends with a zero byte. Before encoding it is

    version u8 | kind u8 | sequence u16 | payload | CRC-16/CCITT-FALSE u16

all little-endian; the CRC covers everything before it. The board answers questions, streams samples of the IMU and
the foot switches, and, where it sits between the computer and the servos, carries the servo bus in frames.

    encode(Frame(Kind.IDENTIFY, sequence=0))
    stream = FrameStream(); stream.feed(data)      # the frames that are whole by now
"""

import math
import struct
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum, IntFlag

VERSION = 1
LONGEST_BODY = 600  # bytes of a frame before COBS; longer ones are dropped by both sides
STREAM_RATE_HZ = 50
DELIMITER = b"\x00"

_HEAD = struct.Struct("<BBH")
_CRC = struct.Struct("<H")
_STREAM = struct.Struct("<HH")
_SERVO = struct.Struct("<HB")
_IDENTITY = struct.Struct("<BBHQ")
_SAMPLE = struct.Struct("<QBB4f3f3f")
_SERVO_REPLY = struct.Struct("<HQB")


class Kind(IntEnum):
    """What a frame is; 0x80 and above come from the board."""

    IDENTIFY = 0x01
    STREAM = 0x02
    SERVO = 0x03
    KEEP_ALIVE = 0x04
    IDENTITY = 0x81
    SAMPLE = 0x82
    SERVO_REPLY = 0x83
    FAULT = 0x84


class Feature(IntFlag):
    """What a board has."""

    SERVO_BUS = 1
    IMU = 2
    FOOT_SWITCHES = 4


class Valid(IntFlag):
    """Which parts of a sample were measured, and whether the watchdog has taken the torque off."""

    ORIENTATION = 1
    ANGULAR_VELOCITY = 2
    LINEAR_ACCELERATION = 4
    CONTACT = 8
    WATCHDOG_TRIPPED = 16


@dataclass(frozen=True)
class Frame:
    """One frame, not yet understood."""

    kind: int
    sequence: int
    payload: bytes = b""


@dataclass(frozen=True)
class Identity:
    """Who a board is. `time_us` counts from its last start."""

    version: int
    features: Feature
    firmware: int
    time_us: int
    name: str


@dataclass(frozen=True)
class Sample:
    """IMU and foot switches at one instant; None stands for what was not measured.

    Attributes:
      time_us: the board's clock since its last start.
      orientation: base in world, x y z w.
      angular_velocity: rad/s in `imu_link`.
      linear_acceleration: m/s^2 with gravity in `imu_link`.
      contact: six switches, leg order of the contract.
      watchdog_tripped: the board has heard nothing for too long and made the servos limp.
    """

    time_us: int
    orientation: tuple[float, ...] | None
    angular_velocity: tuple[float, ...] | None
    linear_acceleration: tuple[float, ...] | None
    contact: tuple[bool, ...] | None
    watchdog_tripped: bool = False


@dataclass(frozen=True)
class ServoReply:
    """What the servo bus answered to the request with the same tag, and when on the board's clock."""

    tag: int
    time_us: int
    complete: bool
    data: bytes


class FrameError(ValueError):
    """A frame whose payload is not what its kind promises."""


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, most significant bit first."""
    return crc_hqx(data, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing: the same data without a zero byte."""
    out = bytearray()
    blocks = data.split(DELIMITER)
    for index, block in enumerate(blocks):
        full = len(block) // 254 * 254
        for at in range(0, full, 254):
            out.append(255)
            out += block[at : at + 254]
        if full and full == len(block) and index == len(blocks) - 1:
            break  # a full last block carries no zero behind it, so nothing is left to say
        out.append(len(block) - full + 1)
        out += block[full:]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """The inverse of `cobs_encode`.

    Raises:
      FrameError: the data hold a zero, or a block reaches past their end.
    """
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            raise FrameError(f"COBS block at byte {at} is broken")
        out += block
        at += code
        if code < 255 and at < len(data):
            out.append(0)
    return bytes(out)


def encode(frame: Frame) -> bytes:
    """One frame as bytes on the wire, its delimiter included."""
    body = _HEAD.pack(VERSION, frame.kind, frame.sequence & 0xFFFF) + frame.payload
    if len(body) + _CRC.size > LONGEST_BODY:
        raise ValueError(f"frame payload: got {len(frame.payload)} bytes, allowed is up to {LONGEST_BODY - 6}")
    return cobs_encode(body + _CRC.pack(crc16(body))) + DELIMITER


def stream_payload(rate_hz: int, watchdog_ms: int) -> bytes:
    """Payload of STREAM: samples a second (0 stops them); silence after which the board makes the servos limp."""
    return _STREAM.pack(rate_hz, watchdog_ms)


def parse_stream(payload: bytes) -> tuple[int, int]:
    """(rate_hz, watchdog_ms)."""
    return _unpack(_STREAM, payload, "STREAM")


def servo_payload(tag: int, replies: int, packet: bytes) -> bytes:
    """Payload of SERVO: forward `packet` to the bus and answer with `tag` and the bytes of `replies` packets."""
    return _SERVO.pack(tag & 0xFFFF, replies) + packet


def parse_servo(payload: bytes) -> tuple[int, int, bytes]:
    """(tag, replies, packet)."""
    tag, replies = _unpack(_SERVO, payload[: _SERVO.size], "SERVO")
    return tag, replies, payload[_SERVO.size :]


def identity_payload(identity: Identity) -> bytes:
    """Payload of IDENTITY."""
    head = _IDENTITY.pack(identity.version, identity.features, identity.firmware, identity.time_us)
    return head + identity.name.encode("ascii")


def parse_identity(payload: bytes) -> Identity:
    """The payload of IDENTITY."""
    version, features, firmware, time_us = _unpack(_IDENTITY, payload[: _IDENTITY.size], "IDENTITY")
    name = payload[_IDENTITY.size :].decode("ascii", errors="replace")
    return Identity(version, Feature(features), firmware, time_us, name)


def sample_payload(sample: Sample) -> bytes:
    """Payload of SAMPLE."""
    vectors = (sample.orientation, sample.angular_velocity, sample.linear_acceleration)
    flags = Valid.WATCHDOG_TRIPPED if sample.watchdog_tripped else Valid(0)
    numbers: list[float] = []
    for flag, values, size in zip(_VECTOR_FLAGS, vectors, (4, 3, 3), strict=True):
        flags |= flag if values is not None else Valid(0)
        numbers += values if values is not None else [0.0] * size
    switches = 0
    if sample.contact is not None:
        flags |= Valid.CONTACT
        switches = sum(1 << i for i, touched in enumerate(sample.contact) if touched)
    return _SAMPLE.pack(sample.time_us, flags, switches, *numbers)


_VECTOR_FLAGS = (Valid.ORIENTATION, Valid.ANGULAR_VELOCITY, Valid.LINEAR_ACCELERATION)


def parse_sample(payload: bytes) -> Sample:
    """The payload of SAMPLE.

    Raises:
      FrameError: the length is wrong, or a number that counts as measured is not finite, or the orientation is no
        rotation.
    """
    time_us, flags, switches, *numbers = _unpack(_SAMPLE, payload, "SAMPLE")
    vectors = (tuple(numbers[:4]), tuple(numbers[4:7]), tuple(numbers[7:]))
    measured = [v if flags & flag else None for flag, v in zip(_VECTOR_FLAGS, vectors, strict=True)]
    for values in measured:
        if values is not None and not all(map(math.isfinite, values)):
            raise FrameError(f"SAMPLE holds {values}, allowed are finite numbers")
    orientation = measured[0]
    if orientation is not None and abs(math.hypot(*orientation) - 1) > 0.05:
        raise FrameError(f"SAMPLE holds the orientation {orientation}, allowed is a unit quaternion")
    contact = tuple(bool(switches >> i & 1) for i in range(6)) if flags & Valid.CONTACT else None
    return Sample(time_us, orientation, measured[1], measured[2], contact, bool(flags & Valid.WATCHDOG_TRIPPED))


def servo_reply_payload(reply: ServoReply) -> bytes:
    """Payload of SERVO_REPLY."""
    return _SERVO_REPLY.pack(reply.tag & 0xFFFF, reply.time_us, int(reply.complete)) + reply.data


def parse_servo_reply(payload: bytes) -> ServoReply:
    """The payload of SERVO_REPLY."""
    tag, time_us, complete = _unpack(_SERVO_REPLY, payload[: _SERVO_REPLY.size], "SERVO_REPLY")
    return ServoReply(tag, time_us, bool(complete), payload[_SERVO_REPLY.size :])


def _unpack(layout: struct.Struct, payload: bytes, name: str) -> tuple:
    if len(payload) != layout.size:
        raise FrameError(f"{name} frame: got {len(payload)} bytes, allowed is {layout.size}")
    return layout.unpack(payload)


class FrameStream:
    """Finds frames in a stream of bytes, whatever lies between them.

    The frames found do not depend on how the stream is cut. A damaged frame costs itself and nothing else.

    Attributes:
      bad: frames dropped for their stuffing, checksum or length.
      foreign_versions: versions of sound frames that this code does not speak.
    """

    def __init__(self) -> None:
        self.bad = 0
        self.foreign_versions: set[int] = set()
        self._buffer = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes, return the frames that are whole now."""
        *ended, rest = data.split(DELIMITER)
        frames = []
        for piece in ended:
            self._take(piece)
            if (frame := self._finish()) is not None:
                frames.append(frame)
        self._take(rest)
        return frames

    def _take(self, piece: bytes) -> None:
        self._buffer += piece
        if len(self._buffer) > LONGEST_BODY + LONGEST_BODY // 254 + 1:
            self._skipping = True
            self._buffer.clear()

    def _finish(self) -> Frame | None:
        encoded, skipped = bytes(self._buffer), self._skipping
        self._buffer.clear()
        self._skipping = False
        if skipped:
            self.bad += 1
            return None
        return self._decode(encoded) if encoded else None

    def _decode(self, encoded: bytes) -> Frame | None:
        try:
            body = cobs_decode(encoded)
        except FrameError:
            self.bad += 1
            return None
        if not _HEAD.size + _CRC.size <= len(body) <= LONGEST_BODY:
            self.bad += 1
            return None
        content, (crc,) = body[: -_CRC.size], _CRC.unpack(body[-_CRC.size :])
        if crc16(content) != crc:
            self.bad += 1
            return None
        version, kind, sequence = _HEAD.unpack(content[: _HEAD.size])
        if version != VERSION:
            self.foreign_versions.add(version)
            return None
        return Frame(kind, sequence, content[_HEAD.size :])
