"""Protocol buffers by hand: enough to write ONNX models and TensorBoard events without their libraries.

message = text(1, "observation") + number(2, 7) + nested(3, floats)
"""

import struct


def varint(value: int) -> bytes:
    """A number that is not negative, seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def number(field: int, value: int) -> bytes:
    """An integer, bool or enum."""
    return varint(field << 3) + varint(value)


def nested(field: int, value: bytes) -> bytes:
    """A message, or bytes."""
    return varint(field << 3 | 2) + varint(len(value)) + value


def text(field: int, value: str) -> bytes:
    """A string."""
    return nested(field, value.encode())


def single(field: int, value: float) -> bytes:
    """A float of 32 bits."""
    return varint(field << 3 | 5) + struct.pack("<f", value)


def double(field: int, value: float) -> bytes:
    """A float of 64 bits."""
    return varint(field << 3 | 1) + struct.pack("<d", value)
