"""Read the records of an MCAP file one after the other, as far as they can be read.

A file whose recorder was killed, or whose disk lost power, has no index and ends in the middle of a record. The scan
yields every message of every complete chunk, then what can be decompressed of an unfinished one, and says in
`damage` what it could not read. A damaged chunk in the middle costs that chunk alone. An intact file is read the
same way. Only a file that is not MCAP at all raises.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Header, Metadata, Schema

from tcbi_contract.wording import counted
from tcbi_infer.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
CDR = "cdr"  # how ROS 2 encodes messages
UNDECODED = "surrogateescape"  # for the bytes of a definition that are no text, so that they can be written again
RECORD_LIMIT = 1 << 32  # bytes; a longer record is damage, not data
_MESSAGE = struct.Struct("<HIQQ")
_FAULTS = (  # of damaged content; a damaged length may be too large for an integer, or for the memory
    ValueError, LookupError, OverflowError, MemoryError, EOFError, RuntimeError,
    struct.error, McapError, zstandard.ZstdError,
)  # fmt: skip


@dataclass(frozen=True)
class Channel:
    """One topic of one file."""

    topic: str
    message_type: str
    message_encoding: str
    schema_encoding: str
    definition: str
    metadata: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Message:
    """One serialized message; times in ns."""

    channel: Channel
    log_time: int
    publish_time: int
    data: bytes


@dataclass
class Scan:
    """The messages of one file and, once they are all read, its state."""

    path: Path
    profile: str = ""
    finished: bool = False  # the file ends as a closed recording does
    damage: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _channels: dict[int, Channel] = field(default_factory=dict)

    def messages(self) -> Iterator[Message]:
        """Every message that can be read, in the order of the file.

        Raises:
          BagError: the file is not MCAP.
        """
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            magic = file.read(len(MAGIC))
            if magic != MAGIC[: len(magic)]:
                raise BagError(
                    f"{self.path}: begins with {magic!r}, an MCAP file begins with {MAGIC!r}; it is another format: "
                    "give a bag that was recorded as MCAP, or turn a log into one with ./tcbi import"
                )
            if len(magic) < len(MAGIC):
                self._damaged("the file ends in its first bytes" if magic else "the file has no bytes", len(magic))
                return
            while not self.finished:
                start = file.tell()
                head = file.read(9)
                if len(head) < 9:
                    self._damaged(
                        "the recording was never closed" if not head else "the file ends inside a record", len(head)
                    )
                    return
                opcode, length = head[0], int.from_bytes(head[1:], "little")
                if (not Opcode.HEADER <= opcode <= Opcode.DATA_END and opcode < 0x80) or length > RECORD_LIMIT:
                    self._damaged(f"no record begins at byte {start}", size - start)
                    return
                if length > size - file.tell():
                    yield from self._unfinished(opcode, file, size - start)
                    return
                yield from self._record(opcode, file, length, start)

    def _damaged(self, text: str, lost: int) -> None:
        self.damage.append(text)
        self.lost_bytes += lost

    def _record(self, opcode: int, file: BinaryIO, length: int, start: int) -> Iterator[Message]:
        if opcode == Opcode.FOOTER:
            file.seek(length, 1)
            self.finished = True
            if file.read(len(MAGIC)) != MAGIC:
                self._damaged("the closing mark is missing", 0)
            return
        if opcode not in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.METADATA):
            file.seek(length, 1)
            return
        content = file.read(length)
        try:
            if opcode == Opcode.CHUNK:
                yield from self._chunk(content)
            else:
                yield from self._content(opcode, content)
        except _FAULTS as e:
            why = str(e) or type(e).__name__
            self._damaged(f"a record of {length} bytes at byte {start} is damaged ({why})", length)

    def _content(self, opcode: int, content: bytes) -> Iterator[Message]:
        """One record that is not a chunk."""
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, publish_time = _MESSAGE.unpack_from(content)
            yield Message(self._channels[channel], log_time, publish_time, content[_MESSAGE.size :])
            return
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            record = ChannelRecord.read(stream)
            self._channels[record.id] = self._channel(record)
        elif opcode == Opcode.HEADER:
            self.profile = Header.read(stream).profile
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata[metadata.name] = dict(metadata.metadata)

    def _channel(self, record: ChannelRecord) -> Channel:
        schema = self._schemas.get(record.schema_id)
        return Channel(
            topic=record.topic,
            message_type=schema.name if schema else "",
            message_encoding=record.message_encoding,
            schema_encoding=schema.encoding if schema else "",
            definition=schema.data.decode(errors=UNDECODED) if schema else "",
            metadata=tuple(record.metadata.items()),
        )

    def _chunk(self, content: bytes) -> Iterator[Message]:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        data = decompressed(chunk.data, chunk.compression, chunk.uncompressed_size)
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("its checksum does not match")
        yield from self._records_in(data)

    def _records_in(self, data: bytes) -> Iterator[Message]:
        at = 0
        while at + 9 <= len(data):
            length = int.from_bytes(data[at + 1 : at + 9], "little")
            if at + 9 + length > len(data):
                return
            yield from self._content(data[at], data[at + 9 : at + 9 + length])
            at += 9 + length

    def _unfinished(self, opcode: int, file: BinaryIO, rest: int) -> Iterator[Message]:
        """The last record of a file that was cut off; only a chunk can hold readable messages."""
        self._damaged("the file ends inside a record", rest)
        if opcode != Opcode.CHUNK:
            return
        content = file.read(rest)
        if len(content) < 32:
            return
        name_length = int.from_bytes(content[28:32], "little")
        body = 32 + name_length + 8
        if name_length > 16 or len(content) <= body:
            return
        compression = content[32 : 32 + name_length].decode("ascii", "replace")
        data = begun(content[body:], compression)
        try:
            yield from self._records_in(data)
        except _FAULTS:
            return  # what was decompressed ends in a damaged record; the loss is already counted


def no_message(bag: Path, scans: Sequence[Scan]) -> BagError:
    """The error of a bag in whose files, all of them read, there is not one message."""
    damage = [f"{scan.path.name}: {text}" for scan in scans for text in scan.damage]
    more = f" and {len(damage) - 1} more places" if len(damage) > 1 else ""
    because = f" ({damage[0]}{more})" if damage else ""
    lost = sum(scan.lost_bytes for scan in scans)
    what = f"not one message can be read, {counted(lost, 'byte')} are lost"
    return BagError(
        f"{bag}: {what if lost else 'the bag is empty, it holds not one message'}{because}; "
        "leave it out, or record it again"
    )


def decompressed(data: bytes, compression: str, size: int) -> bytes:
    """The content of a complete chunk."""
    if size > RECORD_LIMIT:
        raise ValueError(f"its content is said to be {size} bytes, at most {RECORD_LIMIT} are allowed")
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    if compression == "lz4":
        return lz4.frame.decompress(data)
    if compression:
        raise ValueError(f"its compression is {compression!r}, known are zstd and lz4")
    return data


def begun(data: bytes, compression: str) -> bytes:
    """What can be read of a chunk whose end is missing: whole blocks only, so nothing of a small zstd chunk."""
    if not compression:
        return data
    decompressor: zstandard.ZstdDecompressionObj | lz4.frame.LZ4FrameDecompressor
    if compression == "zstd":
        decompressor = zstandard.ZstdDecompressor().decompressobj()
    elif compression == "lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
    else:
        return b""
    parts = []
    for at in range(0, len(data), 1024):  # small bites: an error costs only what follows it
        try:
            parts.append(decompressor.decompress(data[at : at + 1024]))
        except _FAULTS:
            break
    return b"".join(parts)
