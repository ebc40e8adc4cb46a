"""A bag as a schedule of serialized messages, each at the moment of its rollout that it was recorded at. Knows no ROS.

The moment is the message's stamp, so that a recording from a simulator in lockstep plays as evenly as one from a robot.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tcbi_contract import names
from tcbi_infer.bags.clock import stretches
from tcbi_infer.bags.files import mcap_files
from tcbi_infer.bags.scan import Scan, no_message
from tcbi_infer.bags.schemas import MESSAGES, stamp_of
from tcbi_infer.bags.streams import longest_stretch, prefix, relative
from tcbi_infer.errors import BagError
from tcbi_sim.errors import UnknownNameError


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
      UnknownNameError: there is no such topic.
      BagError: the bag cannot be read, or holds none of the topics, or those of several robots.
    """
    for topic in topics:
        if topic not in MESSAGES:
            raise UnknownNameError("topic", topic, tuple(MESSAGES))
    cues: list[Cue] = []
    others: set[str] = set()
    spaces: set[str] = set()
    notes: list[str] = []
    unwanted: set[str] = set()
    scans = [Scan(file) for file in mcap_files(bag)]
    for scan in scans:
        for message in scan.messages():
            name = relative(message.channel.topic, message.channel.message_type)
            if name is None:
                others.add(message.channel.topic)
            elif not topics or name in topics:
                if name == names.JOINT_STATES:
                    spaces.add(prefix(message.channel.topic, name))
                stamp = stamp_of(message.data) or 0
                cues.append(Cue(stamp if stamp > 0 else message.log_time, name, message.data))
            else:
                unwanted.add(name)
        notes += [f"{scan.path.name} is damaged: {text}" for text in scan.damage]
    if not cues and unwanted:
        raise BagError(f"{bag}: holds no message of {', '.join(topics)}; choose from {', '.join(sorted(unwanted))}")
    if not cues and others:
        has = ", ".join(sorted(others))
        raise BagError(f"{bag}: holds no message of the contract's topics; it has {has}; play it with `ros2 bag play`")
    if not cues:
        raise no_message(bag, scans)
    if len(spaces) > 1:
        raise BagError(f"{bag}: holds the joint_states of {len(spaces)} robots; play it with `ros2 bag play`")
    cues = sorted(_on_one_clock(cues, notes), key=lambda cue: cue.time)
    return Schedule(tuple(cues), tuple(sorted(others)), tuple(notes))


def _on_one_clock(cues: list[Cue], notes: list[str]) -> list[Cue]:
    """The longest stretch of a recording, in the order of its file, in which no clock was set back.

    The topic with the most messages says where that is.
    """
    topic = Counter(cue.topic for cue in cues).most_common(1)[0][0]
    beat = np.flatnonzero([cue.topic == topic for cue in cues])
    stamp = np.array([cue.time for cue in cues], np.int64)
    kept = longest_stretch(topic, stamp[beat], notes)
    number = stretches(stamp, beat)
    return [cue for cue, mine in zip(cues, number, strict=True) if mine == number[beat[kept[0]]]]
