"""Publishes a bag's messages again, byte for byte, with the contract's QoS and with /clock, at any speed.

The nodes that listen run with use_sim_time: on their clock everything happens as it did, however fast it is played.
No more is published at once than half of a queue, and the rest once the listeners' middleware has it.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from tcbi_contract import messages, names
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_contract.wording import counted
from tcbi_infer.errors import BagError, InferError
from tcbi_infer.interfaces import STREAMS
from tcbi_infer.player import Cue, schedule
from tcbi_msgs.msg import RolloutEvent
from tcbi_sim.prompt_acks import ask_for_prompt_acks

PERIOD_S = 0.005  # wall time between two looks at the schedule
CLOCK_STEP_NS = 10_000_000  # /clock at 100 Hz of the recording's time
LISTENERS_S = 0.1  # wall time for what is published at once, where a listener confirms nothing
NOW = Duration(seconds=0)
LINGER_S = 1.0  # wall time that the last messages have to arrive before the node ends


@dataclass(frozen=True)
class ReplayParameters:
    """Parameters of the replay node."""

    bag: str = parameter("", "bag folder or .mcap file to play")
    rate: float = parameter(1.0, "speed; 2 is twice as fast as recorded", low=0.01, high=1000.0)
    loop: bool = parameter(False, "start again at the end, the clock going on")
    topics: str = parameter("", "relative names of the topics to play, with spaces between; empty for all")
    wait_for: int = parameter(0, "subscribers of joint_states to wait for before the start", low=0, high=100)
    wait_timeout_s: float = parameter(20.0, "how long to wait for them", low=0.0, high=3600.0)
    publish_clock: bool = parameter(True, "publish /clock")


class ReplayNode(Node):
    """Plays one bag."""

    def __init__(self) -> None:
        super().__init__("replay_node")
        self.values = declare(self, ReplayParameters)
        if not self.values.bag:
            raise BagError("parameter bag: nothing to play; give a bag's folder or an .mcap file")
        self.schedule = schedule(Path(self.values.bag), tuple(self.values.topics.split()))
        for note in self.schedule.notes:
            self.get_logger().warning(note)
        if self.schedule.others:
            self.get_logger().warning(f"not played, being no topics of the contract: {', '.join(self.schedule.others)}")
        self._publishers_of: dict[str, Any] = {name: self._publisher(name) for name in self.schedule.topics}
        self._clock_publisher: Any = None
        if self.values.publish_clock:
            self._clock_publisher = self.create_publisher(ClockMessage, names.CLOCK, messages.STREAM_QOS)
        self._unheard: Counter[str] = Counter()  # messages of each topic since all were known to have arrived
        self._held = False  # there is more to publish, once they have arrived
        self._counted_from = 0.0  # s of the steady clock
        self.published = 0
        self.finished = False
        self._next = 0
        self._shift = 0  # ns added to the stamps of /clock in later rounds
        self._told = 0  # last /clock, ns
        self._made = time.monotonic()
        self._began: float | None = None
        self._ended_at = 0.0
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, messages.STREAM_QOS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, self._on_time, clock=steady)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=steady)

    def _publisher(self, name: str) -> Any:
        kind = RolloutEvent if name == names.ROLLOUT_EVENT else STREAMS[name]
        return self.create_publisher(kind, name, _qos(name))

    def _ready(self) -> bool:
        """Whether enough nodes listen.

        Raises:
          InferError: they do not come in time.
        """
        listened = self._publishers_of.get(names.JOINT_STATES) or next(iter(self._publishers_of.values()))
        there, wanted = listened.get_subscription_count(), self.values.wait_for
        if there < wanted and time.monotonic() - self._made > self.values.wait_timeout_s:
            raise InferError(
                f"{there} of {counted(wanted, 'node')} listen to {listened.topic_name} after "
                f"{self.values.wait_timeout_s:g} s; start them, or wait for fewer (--wait-for)"
            )
        return bool(there >= wanted)

    def _on_time(self) -> None:
        if self.finished:
            if time.monotonic() - self._ended_at > LINGER_S:
                raise SystemExit(0)
            return
        if self._began is None:
            if not self._ready():
                return
            self._began = self._counted_from = time.monotonic()
        elapsed = (time.monotonic() - self._began) * self.values.rate
        self._play_until(self.schedule.start + round(elapsed * 1e9))

    def _play_until(self, now: int) -> None:
        cues = self.schedule.cues
        if self._held and not self._heard():
            return
        while self._next < len(cues) and cues[self._next].time <= now:
            if self._unheard[cues[self._next].topic] >= _most(cues[self._next].topic):
                self._held = True
                return
            self._send(cues[self._next])
        self._tell(min(now, self.schedule.end))
        if self._next == len(cues):
            self._end()

    def _heard(self) -> bool:
        """Whether the listeners' middleware has all that was published, or has had its time."""
        now = time.monotonic()
        patient = now - self._counted_from < LISTENERS_S
        if patient and not all(p.wait_for_all_acked(NOW) for p in self._publishers_of.values()):
            return False
        self._unheard.clear()
        self._held, self._counted_from = False, now
        return True

    def _send(self, cue: Cue) -> None:
        self._tell(cue.time, CLOCK_STEP_NS)
        self._publishers_of[cue.topic].publish(cue.data)
        self._unheard[cue.topic] += 1
        self.published += 1
        self._next += 1

    def _tell(self, now: int, step: int = 0) -> None:
        """/clock, at least `step` ns after the last one."""
        stamp = now + self._shift
        if self._clock_publisher is not None and stamp > self._told + step:
            self._told = stamp
            self._clock_publisher.publish(ClockMessage(clock=messages.to_stamp(stamp)))

    def _diagnose(self) -> None:
        """Its own health, beside what the bag holds of the nodes that were recorded."""
        state = "waiting for listeners" if self._began is None else "finished" if self.finished else "playing"
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="replay_node", message=state)
        status.values = [KeyValue(key="messages published", value=str(self.published))]
        array = DiagnosticArray(status=[status])
        played = self._clock_publisher is not None  # then a recorder's time is the bag's
        array.header.stamp = messages.to_stamp(self._told) if played else self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _end(self) -> None:
        self.get_logger().info(f"played {counted(self.published, 'message')}")
        if not self.values.loop:
            self.finished, self._ended_at = True, time.monotonic()
            return
        self._next, self._began = 0, time.monotonic()
        self._shift += self.schedule.end - self.schedule.start + CLOCK_STEP_NS


def _qos(name: str) -> Any:
    return messages.LATCHED_QOS if name == names.ROLLOUT_EVENT else messages.STREAM_QOS


def _most(name: str) -> int:
    """Messages of a topic to publish before its listeners' middleware has had time."""
    return max(1, int(_qos(name).depth) // 2)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    ask_for_prompt_acks()
    try:
        return run("replay_node", ReplayNode, args)
    except SystemExit as end:
        return int(end.code or 0)
