"""Repair a recording that was cut off: every message that can be read, in a new file with an index and metadata.

The original is kept beside it, with `.damaged` in its name. A bag that nothing ails is left alone.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from tcbi_infer.bags import schemas
from tcbi_infer.bags.files import ASIDE, REPAIRED, bag_name, is_recording, mcap_files, present, set_aside
from tcbi_infer.bags.scan import CDR, Channel, Message, Scan, no_message
from tcbi_infer.bags.writer import UNFINISHED, BagWriter, Topic, offered_qos
from tcbi_infer.errors import BagError


@dataclass
class Recovery:
    """What a repair saved and lost."""

    bag: Path  # what to use from now on
    original: Path | None = None  # where the damaged recording is kept; None if nothing had to be done
    messages: int = 0
    topics: dict[str, int] = field(default_factory=dict)  # messages by topic
    seconds: float = 0.0  # from the first message to the last
    lost_bytes: int = 0  # of the file, compressed
    damage: list[str] = field(default_factory=list)

    @property
    def repaired(self) -> bool:
        return self.original is not None


def recover(bag: Path, owned: bool = False) -> Recovery:
    """Repair a bag's folder or a bare .mcap file in place, keeping the original aside.

    Args:
      owned: the caller holds the lock of the folder that the bag is in.

    Raises:
      BagError: it is no recording, it is an original that a repair kept, or not one message of it can be read.
      RecordingError: the disk is full; the original is untouched then.
    """
    bag = present(bag.parent if bag.name == "metadata.yaml" else bag)
    files = mcap_files(bag)
    is_folder = bag.is_dir()
    if set_aside(bag) or (not is_folder and set_aside(bag.parent)):
        raise BagError(f"{bag}: is the damaged original that a repair kept; to repair it again, rename it first")
    if not owned and bag.suffix == UNFINISHED and is_recording(bag.parent):
        raise BagError(f"{bag}: is being recorded right now; wait for its end, or stop the recorder")
    recovery = Recovery(bag)
    scans = [Scan(file) for file in files]
    first, last = _survey(scans, recovery)
    recovery.seconds = (last - first) * 1e-9 if recovery.messages else 0.0
    final = bag.with_name(bag_name(bag)) if is_folder else bag
    if not recovery.damage and final == bag and (not is_folder or (bag / "metadata.yaml").is_file()):
        return recovery
    if not recovery.messages:
        raise no_message(bag, scans)
    aside = _free_name(final, is_folder)
    if final != bag and final.exists():
        raise BagError(f"{final} exists already; move it away, then recover {bag.name} again")
    written = _rewrite(files, bag.parent, final, is_folder)
    bag.rename(aside)
    with contextlib.suppress(FileNotFoundError):  # a listing of the folder has finished it in between
        written.rename(final)
    recovery.bag, recovery.original = final, aside
    return recovery


def _survey(scans: list[Scan], recovery: Recovery) -> tuple[int, int]:
    """Count what can be read; the first and last time (ns)."""
    first, last = 2**63, 0
    for scan in scans:
        for message in scan.messages():
            first, last = min(first, message.log_time), max(last, message.log_time)
            recovery.messages += 1
            recovery.topics[message.channel.topic] = recovery.topics.get(message.channel.topic, 0) + 1
        recovery.damage += scan.damage
        recovery.lost_bytes += scan.lost_bytes
    return first, last


def _rewrite(files: list[Path], parent: Path, final: Path, is_folder: bool) -> Path:
    """A fresh bag of all readable messages under a hidden name; for a bare file, the file alone."""
    name = bag_name(final)
    workshop, repaired = parent / f".{name}.recovering", parent / f".{final.name}{REPAIRED}"
    if workshop.exists():
        _remove(workshop)
    with BagWriter(workshop, name) as writer:
        known: dict[Channel, Topic] = {}
        for message in _messages(files):
            kind = dataclasses.replace(message.channel, metadata=())  # which may differ from file to file
            if kind not in known:
                known[kind] = _register(writer, message.channel)
            writer.append(known[kind], message.log_time, message.data, message.publish_time)
    if is_folder:
        if repaired.exists():
            _remove(repaired)
        writer.path.rename(repaired)
        workshop.rmdir()
    else:
        (writer.path / f"{name}_0.mcap").replace(repaired)
        _remove(workshop)
    return repaired


def _messages(files: list[Path]) -> Iterator[Message]:
    for file in files:
        yield from Scan(file).messages()


def _register(writer: BagWriter, channel: Channel) -> Topic:
    metadata = dict(channel.metadata)
    try:
        profiles = yaml.safe_load(metadata.get("offered_qos_profiles", "")) or None
    except yaml.YAMLError:
        profiles = None
    return writer.add_topic(
        channel.topic,
        channel.message_type,
        channel.definition,
        channel.schema_encoding,
        metadata.get("topic_type_hash") or _hash(channel),
        profiles if isinstance(profiles, list) else offered_qos(channel.topic),
        channel.message_encoding,
    )


def _hash(channel: Channel) -> str:
    """The hash of a type that the recording does not name; empty where its definition cannot be parsed, or is none."""
    if channel.message_encoding != CDR:
        return ""
    try:
        return schemas.store_for(channel.message_type, channel.schema_encoding, channel.definition).hash_rihs01(
            channel.message_type
        )
    except (BagError, KeyError, ValueError):
        return ""


def _free_name(final: Path, is_folder: bool) -> Path:
    name, suffix = (final.name, "") if is_folder else (final.stem, final.suffix)
    for count in range(1000):
        extra = f".{count}" if count else ""
        candidate = final.with_name(f"{name}{ASIDE}{extra}{suffix}")
        if not candidate.exists():
            return candidate
    raise BagError(f"{final}: a thousand damaged originals are kept beside it; remove some")


def _remove(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir():
            path.rmdir()
        else:
            path.unlink()
    folder.rmdir()
