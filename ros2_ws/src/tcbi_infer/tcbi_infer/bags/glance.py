"""What a bag holds, from its first few kilobytes: enough for a list of many, without reading any of them whole."""

import re
from dataclasses import dataclass
from pathlib import Path

from tcbi_contract import names
from tcbi_infer.bags import schemas
from tcbi_infer.bags.encoding import BEGIN
from tcbi_infer.bags.files import bag_name, mcap_files
from tcbi_infer.bags.note import Note, read_note
from tcbi_infer.bags.scan import Scan
from tcbi_infer.bags.streams import relative
from tcbi_infer.errors import BagError

FEW = 400  # messages looked through for the BEGIN event, which comes first in a bag of the recorder
_NUMBER = re.compile(r"^\s+(nanoseconds|nanoseconds_since_epoch): (\d+)", re.MULTILINE)


@dataclass(frozen=True)
class Glance:
    """The first rollout of a bag, as far as its beginning tells.

    Attributes:
      seconds: of the whole bag, from its metadata; None where it has none.
      started: of the recording, s since 1970 on the recording's own clock; None where nothing says it.
      problem: why nothing could be read; "" where it could.
    """

    path: Path
    rollout_id: str
    task: str = ""
    policy_id: str = ""
    source: str = ""
    rig: str = ""
    slope_roll: float = 0.0  # rad
    slope_pitch: float = 0.0  # rad
    seconds: float | None = None
    started: float | None = None
    problem: str = ""


def glance(bag: Path) -> Glance:
    """Look at a bag's beginning; what cannot be read is said in `problem`, never raised."""
    seconds, started = _extent(bag)
    try:
        event = _begin(mcap_files(bag)[0])
    except (BagError, OSError) as e:
        return Glance(bag, bag_name(bag), seconds=seconds, started=started, problem=" ".join(str(e).split()))
    if event is None:
        return Glance(bag, bag_name(bag), seconds=seconds, started=started)
    note: Note = read_note(event.note)
    return Glance(
        bag,
        event.rollout_id,
        event.task,
        event.policy_id,
        event.source,
        note.rig or "",
        event.slope_roll,
        event.slope_pitch,
        note.duration or seconds,
        started,
    )


def _begin(file: Path):
    """The first BEGIN event of a file, or None if its beginning holds none."""
    for count, message in enumerate(Scan(file).messages()):
        channel = message.channel
        if relative(channel.topic, channel.message_type) == names.ROLLOUT_EVENT:
            try:
                event = schemas.decode(message.data, channel.message_type, channel.schema_encoding, channel.definition)
            except Exception as e:
                raise BagError(f"{file}: its first event cannot be decoded ({e!r})") from e
            if event.kind == BEGIN:
                return event
        if count >= FEW:
            break
    return None


def _extent(bag: Path) -> tuple[float | None, float | None]:
    """Length and start in s from `metadata.yaml`, whose head alone is read: parsing hundreds takes seconds."""
    try:
        with (bag / "metadata.yaml").open(encoding="utf-8") as file:
            found = dict(_NUMBER.findall(file.read(600)))
    except (OSError, UnicodeDecodeError):
        return None, None
    length, start = found.get("nanoseconds"), found.get("nanoseconds_since_epoch")
    return (int(length) / 1e9 if length else None), (int(start) / 1e9 if start else None)
