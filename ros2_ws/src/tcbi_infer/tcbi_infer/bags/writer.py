"""Write a bag as the contract lays it out, so that a kill or a full disk costs the last moments only.

    with BagWriter(folder, "walk_1") as bag:          # folder/walk_1.recording/walk_1_0.mcap
        bag.write("/joint_states", stamp_ns, data)     # the type is known from the contract
                                                       # on leaving: metadata.yaml, then renamed to folder/walk_1

Chunks of some 32 KiB reach the operating system as soon as they are full, or at `flush`. Whatever is on the disk is
a row of complete chunks at any moment. Not safe for several threads.
"""

import contextlib
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tcbi_contract import names
from tcbi_contract.files import replace_file
from tcbi_infer.bags import schemas
from tcbi_infer.bags.scan import CDR, UNDECODED
from tcbi_infer.errors import BagError, RecordingError

CHUNK_SIZE = 32 * 1024  # bytes; about half a second of the robot's topics
UNFINISHED = ".recording"  # suffix of a bag that is being written
METADATA_VERSION = 9  # of rosbag2 in ROS 2 Jazzy
LIBRARY = "tcbi"

_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # how rosbag2 writes an unlimited duration


def qos_profile(durability: str = "volatile", depth: int = 50) -> dict[str, Any]:
    """An offered QoS profile as rosbag2 stores it."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable",
        "durability": durability,
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


def offered_qos(topic: str) -> list[dict[str, Any]]:
    """What the contract's publishers offer on a topic."""
    return [qos_profile("transient_local", 1) if topic.endswith(names.ROLLOUT_EVENT) else qos_profile()]


@dataclass
class Topic:
    """What is known of a topic that is being written; one on which two types were recorded is there twice."""

    name: str
    channel: int
    message_type: str
    message_encoding: str
    type_hash: str
    qos: list[dict[str, Any]]
    count: int = 0


@dataclass
class _Span:
    """Times (ns) and number of what was written."""

    first: int = 2**63 - 1
    last: int = 0
    count: int = 0
    topics: list[Topic] = field(default_factory=list)


class WholeFile:
    """A file without buffers that never keeps a part of a write: a failed one is cut away again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("xb", buffering=0)
        self._size = 0

    def write(self, data: bytes) -> int:
        """Append all of `data`.

        Raises:
          RecordingError: the disk took only a part of it, or nothing.
        """
        try:
            view = memoryview(data)
            while view:
                view = view[self._file.write(view) :]
        except OSError as e:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
            raise RecordingError(
                f"{self.path}: cannot be written any more ({e.strerror}); what was recorded before is kept; "
                "make room on the disk"
            ) from e
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing waits in this process."""

    def close(self, to_disk: bool = True) -> None:
        if to_disk:
            os.fsync(self._file.fileno())
        self._file.close()


class BagWriter:
    """One bag, written under a temporary name until it is closed.

    Args:
      folder: where the bag's own folder is made.
      name: the bag's name, usually the rollout's id.
      custom: strings for `custom_data` in metadata.yaml.
    """

    def __init__(self, folder: Path, name: str, custom: Mapping[str, str] | None = None) -> None:
        if not _is_plain(name):
            raise BagError(f"a bag's name: got {name!r}, allowed is a plain file name")
        self.path = folder / name
        self.working_path = folder / (name + UNFINISHED)
        self._custom = dict(custom or {})
        self._span = _Span()
        self._by_name: dict[str, Topic] = {}
        for path in (self.path, self.working_path):
            if path.exists():
                raise BagError(f"{path} exists already; move it away or choose another name")
        try:
            self.working_path.mkdir(parents=True)
            self._file = WholeFile(self.working_path / f"{name}_0.mcap")
        except OSError as e:
            raise RecordingError(f"{self.working_path}: cannot be made ({e.strerror}); choose another folder") from e
        self._mcap = McapWriter(self._file, CHUNK_SIZE, CompressionType.ZSTD)  # type: ignore[arg-type]
        self._mcap.start("ros2", LIBRARY)
        self._header_size = self._file.tell()

    @property
    def count(self) -> int:
        """Messages written so far."""
        return self._span.count

    @property
    def holds_data(self) -> bool:
        """Whether a chunk of messages is on the disk."""
        return self._file.tell() > self._header_size

    def add_topic(
        self,
        topic: str,
        message_type: str,
        definition: str = "",
        encoding: str = "ros2msg",
        type_hash: str = "",
        qos: Sequence[dict[str, Any]] | None = None,
        message_encoding: str = CDR,
    ) -> Topic:
        """Register a topic; a type of the contract needs no definition.

        Args:
          topic: full name, with namespace.
          definition: schema text with every nested type.
          qos: offered profiles; None for the contract's.

        Returns: what `append` takes.
        """
        ours = not definition and message_encoding == CDR and message_type in schemas.MESSAGES.values()
        text = schemas.definition(message_type) if ours else definition
        profiles = list(offered_qos(topic) if qos is None else qos)
        code = schemas.type_hash(message_type) if ours else type_hash
        no_schema = not message_type and not text  # as JSON may be
        schema = 0 if no_schema else self._mcap.register_schema(message_type, encoding, text.encode(errors=UNDECODED))
        metadata = {"offered_qos_profiles": yaml.safe_dump(profiles, sort_keys=False)}
        if code:
            metadata["topic_type_hash"] = code
        channel = self._mcap.register_channel(topic, message_encoding, schema, metadata)
        entry = Topic(topic, channel, message_type, message_encoding, code, profiles)
        self._span.topics.append(entry)
        self._by_name[topic] = entry
        return entry

    def write(self, topic: str, log_time: int, data: bytes, publish_time: int | None = None) -> None:
        """Append one serialized message; a topic of the contract registers itself.

        Args:
          log_time, publish_time: ns.
        """
        entry = self._by_name.get(topic) or self.add_topic(topic, contract_type(topic))
        self.append(entry, log_time, data, publish_time)

    def append(self, entry: Topic, log_time: int, data: bytes, publish_time: int | None = None) -> None:
        """Append one serialized message to a topic that is registered; times as for `write`."""
        log_time = max(log_time, 0)
        published = log_time if publish_time is None else max(publish_time, 0)
        self._mcap.add_message(entry.channel, log_time, data, published, entry.count)
        span = self._span
        span.first, span.last = min(span.first, log_time), max(span.last, log_time)
        span.count += 1
        entry.count += 1

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._mcap.flush()

    def close(self) -> Path:
        """Finish the file, write metadata.yaml, take the final name; returns it.

        Raises:
          RecordingError: the disk refuses it; what is on it is whole but for the metadata.
        """
        metadata = self._metadata()
        text = yaml.safe_dump(metadata["rosbag2_bagfile_information"], sort_keys=False)
        self._mcap.flush()
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": text})
        self._mcap.finish()
        try:
            self._file.close()
            return self._settle(metadata)
        except OSError as e:
            raise RecordingError(
                f"{self.path}: recorded, but its metadata cannot be written ({e.strerror}); make room on the disk, "
                f"then ./tcbi recover {self.path}"
            ) from e

    def give_up(self) -> Path:
        """After a failed write: keep the complete chunks, without an index, under the final name if the disk allows it.

        Returns: where they are.
        """
        with contextlib.suppress(OSError):
            self._file.close(to_disk=False)
        with contextlib.suppress(OSError):
            self.working_path.rename(self.path)
        return self.path if self.path.exists() else self.working_path

    def discard(self) -> None:
        """Remove everything written so far, as far as the disk allows it."""
        with contextlib.suppress(OSError):
            self._file.close(to_disk=False)
        shutil.rmtree(self.working_path, ignore_errors=True)

    def _settle(self, metadata: dict[str, Any]) -> Path:
        write_metadata(self.working_path, metadata)
        self.working_path.rename(self.path)
        sync_folder(self.path.parent)
        return self.path

    def _metadata(self) -> dict[str, Any]:
        span = self._span
        first = span.first if span.count else 0
        duration = {"nanoseconds": span.last - first if span.count else 0}
        start = {"nanoseconds_since_epoch": first}
        name = self._file.path.name
        return {
            "rosbag2_bagfile_information": {
                "version": METADATA_VERSION,
                "storage_identifier": "mcap",
                "duration": duration,
                "starting_time": start,
                "message_count": span.count,
                "topics_with_message_count": [_topic_entry(entry) for entry in span.topics],
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [name],
                "files": [{"path": name, "starting_time": start, "duration": duration, "message_count": span.count}],
                "custom_data": self._custom or None,
                "ros_distro": "jazzy",
            }
        }

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except RecordingError:
            self.give_up()
            raise


def check_free(folder: Path, names: Sequence[str]) -> None:
    """That a bag of each name can be made in a folder.

    Raises:
      BagError: two bear one name, there is one already, or it is no name for a bag; all of them are named.
    """
    taken = [folder / end for name in dict.fromkeys(names) for end in (name, name + UNFINISHED)]
    faults = [f"{path} exists already" for path in taken if path.exists()]
    faults += [f"{count} rollouts are named {name!r}" for name, count in Counter(names).items() if count > 1]
    faults += [f"{name!r} is no plain file name" for name in names if not _is_plain(name)]
    if faults:
        raise BagError(f"{'; '.join(faults)}; give the logs other names, move bags away, or choose another folder")


def _is_plain(name: str) -> bool:
    return bool(name) and name == Path(name).name and not name.startswith(".")


def contract_type(topic: str) -> str:
    """The message type of a contract topic under any namespace.

    Raises:
      BagError: the contract does not know the topic.
    """
    for name, message_type in schemas.MESSAGES.items():
        if topic.strip("/") == name or topic.endswith("/" + name):
            return message_type
    raise BagError(f"topic {topic!r}: the contract knows {', '.join(schemas.MESSAGES)}; give its type with add_topic")


def _topic_entry(entry: Topic) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": entry.name,
            "type": entry.message_type,
            "serialization_format": entry.message_encoding,
            "offered_qos_profiles": entry.qos,
            "type_description_hash": entry.type_hash,
        },
        "message_count": entry.count,
    }


class _PlainDumper(yaml.SafeDumper):
    """No anchors: rosbag2's parser reads them, other readers may not."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def write_metadata(folder: Path, metadata: dict[str, Any]) -> None:
    """metadata.yaml, whole or not at all."""
    replace_file(folder / "metadata.yaml", yaml.dump(metadata, Dumper=_PlainDumper, sort_keys=False))
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` last through a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
