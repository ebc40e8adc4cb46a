"""Which rollouts a recording holds: the stretches between BEGIN and END or ABORT of `rollout/event`."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from tcbi_contract import names
from tcbi_infer.bags.clock import how_often, set_back, stretches
from tcbi_infer.bags.encoding import ABORT, BEGIN
from tcbi_infer.bags.files import bag_name
from tcbi_infer.bags.note import Note, read_note
from tcbi_infer.bags.streams import Record, Recording
from tcbi_infer.errors import BagError
from tcbi_sim.episode import block_of
from tcbi_sim.measurement import Block, Scenario

UNKNOWN_TASK = "unknown"
NO_END = "no END event: the rollout is used as far as it was recorded"


@dataclass(frozen=True)
class Span:
    """One rollout's place in a recording."""

    rollout_id: str
    begin: int  # ns, the zero of its clock
    end: int | None  # ns; None if the recording stops first
    task: str = UNKNOWN_TASK
    policy_id: str = ""
    source: str = ""
    slope_roll: float = 0.0  # rad
    slope_pitch: float = 0.0  # rad
    blocks: tuple[Block, ...] = ()
    distance: float = math.nan  # m
    note: Note = field(default_factory=Note)
    notes: tuple[str, ...] = ()

    def scenario(self, last: int) -> Scenario:
        """What the rollout asked for; `last` (ns) is its last sample."""
        took = ((self.end if self.end is not None else last) - self.begin) / 1e9
        planned = self.note.duration
        duration = planned if planned is not None and took > planned - 1e-6 else took
        return Scenario(
            task=self.task,
            duration=duration,
            slope_roll=self.slope_roll,
            slope_pitch=self.slope_pitch,
            blocks=self.blocks,
            initial_joint_position=self.note.initial_joint_position,
            initial_joint_velocity=self.note.initial_joint_velocity,
            initial_yaw=self.note.initial_yaw,
            settle=self.note.settle,
            seed=self.note.seed,
            constants=self.note.constants,
        )


def rollouts(recording: Recording) -> list[tuple[Recording, Span]]:
    """The rollouts of a recording, each with the part that it lies in.

    Where the clock was set back, a rollout is used up to there: of what follows nobody knows how it started. Without
    any event the longest stretch counts as one rollout.

    Raises:
      BagError: there is nothing to take the time from.
    """
    beats = recording.records.get(names.JOINT_STATES, [])
    stamp = np.array([record.stamp for record in beats], np.int64)
    if not len(set_back(stamp)):
        return [(recording, span) for span in spans(recording)]
    parts = _parts(recording)
    begun = [part for part in parts if any(record.message.kind == BEGIN for record in _events(part))]
    ended = [part for part in parts if _events(part)]
    found: dict[str, tuple[Recording, Span]] = {}
    for part in begun or ended:
        for span in spans(part):
            jumped = part is not parts[-1]
            found.setdefault(span.rollout_id, (part, _until(span, how_often(stamp)) if jumped else span))
    if found:
        return list(found.values())
    part = max(parts, key=lambda part: len(part.records[names.JOINT_STATES]))
    kept = f"only the longest stretch is used, {len(part.records[names.JOINT_STATES])} of {len(beats)} samples"
    return [(replace(part, notes=[*part.notes, f"{how_often(stamp)}; {kept}"]), span) for span in spans(part)]


def _events(recording: Recording) -> list[Record]:
    return recording.records.get(names.ROLLOUT_EVENT, [])


def _parts(recording: Recording) -> list[Recording]:
    """The stretches of a recording between which its clock was set back."""
    records = sorted(
        ((record.place, topic, record) for topic, found in recording.records.items() for record in found),
        key=lambda one: one[0],
    )
    beat = np.array([i for i, (_, topic, _) in enumerate(records) if topic == names.JOINT_STATES])
    number = stretches(np.array([record.stamp for *_, record in records], np.int64), beat)
    parts = [replace(recording, records={}) for _ in range(int(number.max()) + 1)]
    for mine, (_, topic, record) in zip(number, records, strict=True):
        if mine >= 0:
            parts[mine].records.setdefault(topic, []).append(record)
    return parts


def _until(span: Span, jump: str) -> Span:
    """A span, which has no end where the clock was set back within."""
    if span.end is not None:
        return span
    return replace(
        span, notes=tuple(f"{jump}; the rollout is used up to there" if n == NO_END else n for n in span.notes)
    )


def spans(recording: Recording) -> list[Span]:
    """The rollouts of a recording; one that has no events is one rollout, and says so.

    Raises:
      BagError: there is nothing to take the time from.
    """
    events = recording.records.get(names.ROLLOUT_EVENT, [])
    found: list[Span] = []
    begun: Record | None = None
    for record in events:
        if record.message.kind == BEGIN:
            if begun is not None and record.message.rollout_id == begun.message.rollout_id:
                continue  # a latched event, heard twice
            if begun is not None:
                found.append(_span(begun, None))
            begun = record
        elif begun is not None:
            found.append(_span(begun, record))
            begun = None
        elif not found:
            found.append(_without_begin(record, recording))
    if begun is not None:
        found.append(_span(begun, None))
    return found or [_whole(recording)]


def _span(begin: Record, end: Record | None) -> Span:
    message = begin.message
    notes, policy_id = [], message.policy_id
    if end is not None and end.message.policy_id not in ("", policy_id):
        policy_id = f"{policy_id} then {end.message.policy_id}"
        notes.append(f"the policy was changed meanwhile ({policy_id}): the commands can be replayed, the policy cannot")
    if end is None:
        notes.append(NO_END)
    elif end.message.kind == ABORT:
        reason = read_note(end.message.note).text
        notes.append(f"the rollout was aborted{f' ({reason})' if reason else ''}; it is used as far as it went")
    elif end is not begin and (said := read_note(end.message.note).text):
        notes.append(f"its END says: {said}")
    return Span(
        rollout_id=message.rollout_id,
        begin=begin.stamp,
        end=None if end is None else end.stamp,
        task=message.task or UNKNOWN_TASK,
        policy_id=policy_id,
        source=message.source,
        slope_roll=message.slope_roll,
        slope_pitch=message.slope_pitch,
        blocks=tuple(block_of(block) for block in message.blocks),
        distance=message.distance if end is None else end.message.distance,
        note=read_note(message.note),
        notes=tuple(notes),
    )


def _without_begin(end: Record, recording: Recording) -> Span:
    whole = _span(end, end)
    first = _first_stamp(recording)
    note = (
        "no BEGIN event, its moment is lost: time zero is the first joint_states stamp, the initial posture is unknown"
    )
    return Span(**{**whole.__dict__, "begin": first, "notes": (*whole.notes, note)})


def _whole(recording: Recording) -> Span:
    note = (
        "no rollout/event: time zero is the first joint_states stamp, and the ground counts as flat and empty; "
        "slope, blocks, task and policy are unknown"
    )
    return Span(bag_name(recording.path), _first_stamp(recording), None, notes=(note,))


def _first_stamp(recording: Recording) -> int:
    records = recording.records.get(names.JOINT_STATES)
    if not records:
        raise BagError(f"{recording.path}: {lacking(recording)}")
    return records[0].stamp if len(records) < 3 else min(record.stamp for record in records[:3])


def lacking(recording: Recording) -> str:
    """What to say of a bag without joint states."""
    topics = ", ".join(recording.topics[:6]) + (", …" if len(recording.topics) > 6 else "")
    return (
        f"no joint_states (sensor_msgs/JointState) in it, without which nothing can be compared; it has {topics}; "
        "record it while the driver or the sim node runs (./tcbi collect), or remap the robot's own topic to that name"
    )
