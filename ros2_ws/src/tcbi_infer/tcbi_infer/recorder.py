"""Records one bag per rollout out of a stream of serialized messages. Knows no ROS; the node feeds it.

    recorder = Recorder()
    recorder.add("/joint_states", stamp, log_time, data)       # always, also between rollouts
    recorder.begin(folder, "walk_1", begin_ns, event_bytes)     # takes in what has just come before
    recorder.end(end_ns, wall_s)                                # goes on until every topic has reached the end
    if recorder.settled(wall_s): recorder.close(event_bytes)    # the bag, under its final name

A rollout is what bears a stamp from BEGIN to END, whatever order it arrives in. A failing disk raises RecordingError
once, keeps what is on the disk, and leaves the recorder idle.
"""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from tcbi_contract import names
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.bags.writer import BagWriter
from tcbi_infer.errors import RecordingError

BEFORE_S = 2.0  # how much is kept in case that a BEGIN is still on its way
BEFORE_MESSAGES = 4000
SETTLE_S = 1.0  # wall time that a late message after END is waited for
# what marks the progress of a rollout's time; the distance is that of the last pose
SENSORS = (names.JOINT_STATES, names.IMU, names.FOOT_CONTACTS, names.TRACKER_POSE)


@dataclass(frozen=True)
class Arrival:
    """One serialized message; times in ns."""

    topic: str  # full name
    stamp: int
    log_time: int
    data: bytes


@dataclass
class Rollout:
    """The rollout that is being recorded."""

    rollout_id: str
    begin: int  # ns
    bag: BagWriter
    end: int | None = None  # ns; known before it comes where the rollout is of a given duration
    ended_at_s: float | None = None  # wall time at which END was said
    newest: dict[str, int] = field(default_factory=dict)  # sensor topic -> newest stamp, ns


class Recorder:
    """The state of recording: at most one rollout at a time.

    Args:
      event_topic: full name of `rollout/event`, under which events are written.
    """

    def __init__(self, event_topic: str = "/" + names.ROLLOUT_EVENT) -> None:
        self.event_topic = event_topic
        self.rollout: Rollout | None = None
        self.received = 0
        self.recorded = 0
        self._before: deque[Arrival] = deque(maxlen=BEFORE_MESSAGES)

    def add(self, topic: str, stamp: int, log_time: int, data: bytes) -> None:
        """Take one message.

        Raises:
          RecordingError: the disk refuses it; the rollout is closed as far as it got.
        """
        self.received += 1
        arrival = Arrival(topic, stamp, log_time, data)
        if self.rollout is None or self.rollout.ended_at_s is not None:
            self._keep(arrival)  # it may belong to a rollout whose BEGIN is on its way
        if self.rollout is not None:
            self._record(self.rollout, arrival)

    def begin(
        self,
        folder: RecordingFolder,
        rollout_id: str,
        begin: int,
        event: bytes,
        end: int | None = None,
        min_free_mb: float = 0.0,
    ) -> None:
        """Open a bag, the messages since `begin` (ns) that have come already included.

        Args:
          end: ns, if it is known already.

        Raises:
          BagError: the id is no file name, or is taken.
          RecordingError: the disk is full or refuses it.
        """
        if self.rollout is not None:
            raise RecordingError(f"rollout {self.rollout.rollout_id!r} is still being recorded; end it first")
        folder.require_space(min_free_mb)
        rollout = Rollout(rollout_id, begin, BagWriter(folder.path, rollout_id), end)
        self.rollout = rollout
        self._write(rollout, Arrival(self.event_topic, begin, begin, event))
        self._flush(rollout)  # BEGIN is on the disk before anything moves
        early, self._before = self._before, deque(maxlen=BEFORE_MESSAGES)
        for arrival in early:
            self._record(rollout, arrival)

    def end(self, end: int, wall_s: float) -> None:
        """The rollout ends at `end` (ns); messages that are still on their way are waited for."""
        if self.rollout is not None and self.rollout.ended_at_s is None:
            self.rollout.end, self.rollout.ended_at_s = end, wall_s

    def settled(self, wall_s: float) -> bool:
        """Whether every sensor topic that has spoken has reached the end, or was waited for long enough."""
        rollout = self.rollout
        if rollout is None or rollout.end is None or rollout.ended_at_s is None:
            return False
        reached = bool(rollout.newest) and all(stamp >= rollout.end for stamp in rollout.newest.values())
        return reached or wall_s - rollout.ended_at_s > SETTLE_S

    def close(self, event: bytes, end: int | None = None) -> Path:
        """Write the END or ABORT event and finish the bag; returns it.

        Raises:
          RecordingError: the disk is full; the bag is kept as far as it got.
        """
        rollout = self._active()
        stamp = end if end is not None else (rollout.end if rollout.end is not None else rollout.begin)
        self._write(rollout, Arrival(self.event_topic, stamp, stamp, event))
        try:
            path = rollout.bag.close()
        except RecordingError:
            self._give_up(rollout)
            raise
        self.rollout = None
        return path

    def discard(self) -> None:
        """Remove what was recorded of a rollout that is none."""
        if self.rollout is not None:
            self.rollout.bag.discard()
            self.rollout = None

    def flush(self) -> None:
        """Hand what was recorded to the operating system, where a kill cannot lose it."""
        if self.rollout is not None:
            self._flush(self.rollout)

    def _active(self) -> Rollout:
        if self.rollout is None:
            raise RecordingError("no rollout is being recorded; begin one first")
        return self.rollout

    def _keep(self, arrival: Arrival) -> None:
        self._before.append(arrival)
        while arrival.log_time - self._before[0].log_time > BEFORE_S * 1e9:
            self._before.popleft()

    def _record(self, rollout: Rollout, arrival: Arrival) -> None:
        if arrival.stamp < rollout.begin:
            return
        name = arrival.topic
        if name.endswith(SENSORS):
            rollout.newest[name] = max(arrival.stamp, rollout.newest.get(name, 0))
        if rollout.end is not None:
            # a command given at the very end moves nothing any more; whether it still arrives is a matter of luck
            late = arrival.stamp >= rollout.end if name.endswith(names.JOINT_COMMANDS) else arrival.stamp > rollout.end
            if late:
                return
        self._write(rollout, arrival)

    def _write(self, rollout: Rollout, arrival: Arrival) -> None:
        try:
            rollout.bag.write(arrival.topic, arrival.log_time, arrival.data, arrival.stamp)
        except RecordingError:
            self._give_up(rollout)
            raise
        self.recorded += 1

    def _flush(self, rollout: Rollout) -> None:
        try:
            rollout.bag.flush()
        except RecordingError:
            self._give_up(rollout)
            raise

    def _give_up(self, rollout: Rollout) -> None:
        self.rollout = None
        if rollout.bag.holds_data:
            rollout.bag.give_up()
        else:
            rollout.bag.discard()
