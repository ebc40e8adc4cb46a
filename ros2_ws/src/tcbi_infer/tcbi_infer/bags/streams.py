"""The contract's topics of one recording, decoded and put in order.

Each topic becomes a `Stream`: stamps (ns) that strictly increase, and one row of values a stamp. What had to be dropped
or sorted to get there is said in notes, a line each.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract import names
from tcbi_contract.wording import counted
from tcbi_infer.bags import schemas
from tcbi_infer.bags.clock import how_often, set_back
from tcbi_infer.bags.files import mcap_files
from tcbi_infer.bags.scan import CDR, Channel, Message, Scan, no_message
from tcbi_infer.errors import BagError


@dataclass(frozen=True)
class Record:
    """One decoded message."""

    stamp: int  # ns, of its header; its log time where the header is empty
    log_time: int  # ns
    message: Any
    place: int = 0  # its number among all messages of the bag


@dataclass
class Recording:
    """The decoded messages of one bag, by relative topic."""

    path: Path
    namespace: str = ""
    records: dict[str, list[Record]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    count: int = 0  # messages of any topic
    topics: tuple[str, ...] = ()  # every topic in the bag, full names


def load(bag: Path, namespace: str | None = None) -> Recording:
    """Decode the contract's topics of a bag, cut off or not.

    Args:
      namespace: which robot, where a bag holds several; None if there is one.

    Raises:
      BagError: no bag, no MCAP, nothing in it, several robots, or a type that cannot be decoded.
    """
    kept: dict[str, list[tuple[int, Message]]] = {}
    types: dict[str, str] = {}
    recording = Recording(bag)
    scans = [Scan(file) for file in mcap_files(bag)]
    for scan in scans:
        for message in scan.messages():
            recording.count += 1
            topic = message.channel.topic
            types[topic] = message.channel.message_type
            if relative(topic, message.channel.message_type) is not None:
                kept.setdefault(topic, []).append((recording.count, message))
        recording.notes += _cut(scan)
    recording.topics = tuple(sorted(types))
    if not recording.count:
        raise no_message(bag, scans)
    recording.namespace = _namespace(bag, kept, namespace)
    for topic, messages in kept.items():
        name = relative(topic, types[topic])
        if name is None or prefix(topic, name) != recording.namespace:
            continue
        if name == names.DIAGNOSTICS:
            recording.records[name] = _optional(name, messages)
        else:
            recording.records[name] = _records(name, messages, recording.notes)
    return recording


def relative(topic: str, message_type: str) -> str | None:
    """The contract's name of a topic under any namespace, if its type is the contract's too."""
    for name, expected in schemas.MESSAGES.items():
        if message_type == expected and ("/" + topic.strip("/")).endswith("/" + name):
            return name
    return None


def prefix(topic: str, name: str) -> str:
    """The namespace of a topic, without slashes at its ends."""
    return topic.strip("/").removesuffix(name).strip("/")


def _namespace(bag: Path, kept: dict[str, list[tuple[int, Message]]], wanted: str | None) -> str:
    name = names.JOINT_STATES
    found = sorted(
        {prefix(topic, name) for topic, m in kept.items() if relative(topic, m[0][1].channel.message_type) == name}
    )
    if wanted is not None:
        if wanted.strip("/") not in found:
            raise BagError(
                f"{bag}: no joint_states under the namespace {wanted!r}; it has {', '.join(map(repr, found)) or 'none'}"
            )
        return wanted.strip("/")
    if len(found) > 1:
        raise BagError(
            f"{bag}: joint_states of {len(found)} robots ({', '.join(map(repr, found))}); choose one with --namespace"
        )
    return found[0] if found else ""


def _cut(scan: Scan) -> list[str]:
    if not scan.damage:
        return []
    more = f" and {len(scan.damage) - 1} more places" if len(scan.damage) > 1 else ""
    return [
        f"{scan.path.name} is damaged: {scan.damage[0]}{more}; {scan.lost_bytes} bytes are unreadable, the rest is "
        f"used (./tcbi recover writes a repaired copy)"
    ]


def _records(name: str, messages: list[tuple[int, Message]], notes: list[str]) -> list[Record]:
    records, unstamped, broken = [], 0, 0
    for place, message in messages:
        try:
            decoded = _decoded(message.channel, message.data)
        except BagError:
            raise
        except Exception:  # noqa: BLE001 - a message's bytes may fail in any way; it is counted and said
            broken += 1
            continue
        stamp = schemas.stamp_of(message.data) or 0
        if stamp <= 0:
            unstamped += 1
            stamp = message.log_time
        records.append(Record(stamp, message.log_time, decoded, place))
    if broken:
        notes.append(f"{name}: {broken} of {len(messages)} messages do not match their own definition and are left out")
    if unstamped:
        notes.append(
            f"{name}: {unstamped} of {len(messages)} messages bear no stamp; the time they were recorded at is used"
        )
    return records


def _optional(name: str, messages: list[tuple[int, Message]]) -> list[Record]:
    """What a recording is as good without: nothing is said of messages that cannot be read."""
    try:
        return _records(name, messages, [])
    except BagError:
        return []


def _decoded(channel: Channel, data: bytes) -> Any:
    if channel.message_encoding != CDR:
        raise BagError(f"{channel.topic}: its messages are {channel.message_encoding!r}, allowed is 'cdr' of ROS 2")
    return schemas.decode(data, channel.message_type, channel.schema_encoding, channel.definition)


@dataclass(frozen=True)
class Stream:
    """Rows of one topic."""

    stamp: np.ndarray  # (N,) int64 ns, strictly increasing
    values: np.ndarray  # (N, ...)

    def __len__(self) -> int:
        return len(self.stamp)

    def between(self, first: int, last: int) -> "Stream":
        """The rows with first <= stamp <= last (ns)."""
        inside = (self.stamp >= first) & (self.stamp <= last)
        return Stream(self.stamp[inside], self.values[inside])


def stream(
    name: str, records: Iterable[Record], row: Callable[[Any], Any | None], notes: list[str], dtype: type = float
) -> Stream | None:
    """One topic as rows in the order of time; None if nothing is left.

    Args:
      row: a message's values, or None where it holds none.
    """
    stamps, rows = [], []
    for record in records:
        values = row(record.message)
        if values is not None:
            stamps.append(record.stamp)
            rows.append(values)
    if not rows:
        return None
    order = ordered(name, np.array(stamps, np.int64), notes)
    return Stream(np.array(stamps, np.int64)[order], np.array(rows, dtype)[order])


def ordered(name: str, stamp: np.ndarray, notes: list[str]) -> np.ndarray:
    """Indices that make stamps (ns) increase strictly, what they leave out or move being said in `notes`.

    Where a clock was set back, the longest stretch before or after is kept. Messages that overtook each other are
    sorted. Of samples with one stamp the first is kept.
    """
    if not len(stamp):
        return np.empty(0, int)
    order = longest_stretch(name, stamp, notes)
    moved = int(np.sum(np.diff(stamp[order]) < 0))
    order = order[np.argsort(stamp[order], kind="stable")]
    fresh = np.concatenate([[True], np.diff(stamp[order]) > 0])
    if moved:
        notes.append(f"{name}: {counted(moved, 'sample')} arrived out of order, now sorted by stamp")
    if not fresh.all():
        notes.append(f"{name}: left out {counted(int(np.sum(~fresh)), 'sample')} with the stamp of another")
    return order[fresh]


def longest_stretch(name: str, stamp: np.ndarray, notes: list[str]) -> np.ndarray:
    """Indices of the longest stretch of stamps (ns) in which no clock was set back; one that was is said in `notes`."""
    order = np.arange(len(stamp))
    back = set_back(stamp)
    if back.size:
        order = max(np.split(order, back + 1), key=len)
        notes.append(
            f"{name}: {how_often(stamp)}; only the longest stretch is used, {len(order)} of {len(stamp)} samples"
        )
    return order
