"""A bag as a schedule of serialized messages, each at the moment of its rollout that it was recorded at. Knows no ROS.

The moment is the message's stamp, so that a recording from a simulator in lockstep plays as evenly as one from a robot.
"""

from dataclasses import dataclass
from pathlib import Path

from tcbi_contract import names
from tcbi_infer.bags.files import mcap_files
from tcbi_infer.bags.scan import Scan
from tcbi_infer.bags.schemas import MESSAGES, stamp_of
from tcbi_infer.bags.streams import prefix, relative
from tcbi_infer.errors import BagError


@dataclass(frozen=True)
class Cue:
    """One message to publish."""

    time: int  # ns, on the recording's clock
    topic: str  # the contract's relative name
    data: bytes


@dataclass(frozen=True)
class Schedule:
    """What a bag publishes, in order of time."""

    cues: tuple[Cue, ...]
    others: tuple[str, ...]  # topics in the bag that the contract does not know
    notes: tuple[str, ...]

    @property
    def start(self) -> int:
        """Time of the first message, ns."""
        return self.cues[0].time

    @property
    def end(self) -> int:
        """Time of the last message, ns."""
        return self.cues[-1].time

    @property
    def topics(self) -> tuple[str, ...]:
        """The contract's topics in it."""
        return tuple(name for name in MESSAGES if any(cue.topic == name for cue in self.cues))


def schedule(bag: Path, topics: tuple[str, ...] = ()) -> Schedule:
    """The contract's messages of a bag, cut off or not; a namespace is taken off.

    Args:
      topics: relative names; empty for all.

    Raises:
      BagError: the bag cannot be read, or holds none of the topics, or those of several robots.
    """
    unknown = sorted(set(topics) - set(MESSAGES))
    if unknown:
        raise BagError(f"topics: got {', '.join(unknown)}, allowed are {', '.join(MESSAGES)}")
    cues: list[Cue] = []
    others: set[str] = set()
    spaces: set[str] = set()
    notes: list[str] = []
    for file in mcap_files(bag):
        scan = Scan(file)
        for message in scan.messages():
            name = relative(message.channel.topic, message.channel.message_type)
            if name is None:
                others.add(message.channel.topic)
            elif not topics or name in topics:
                if name == names.JOINT_STATES:
                    spaces.add(prefix(message.channel.topic, name))
                stamp = stamp_of(message.data) or 0
                cues.append(Cue(stamp if stamp > 0 else message.log_time, name, message.data))
        notes += [f"{file.name} is damaged: {text}" for text in scan.damage]
    if not cues:
        raise BagError(
            f"{bag}: holds no message of the contract's topics; it has {', '.join(sorted(others)) or 'none'}"
        )
    if len(spaces) > 1:
        raise BagError(f"{bag}: holds the joint_states of {len(spaces)} robots; play it with `ros2 bag play`")
    cues.sort(key=lambda cue: cue.time)
    return Schedule(tuple(cues), tuple(sorted(others)), tuple(notes))
