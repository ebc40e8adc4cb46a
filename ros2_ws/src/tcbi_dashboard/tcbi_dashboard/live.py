"""The graph as the page sees it: what a node in a background thread has heard, and what it may be asked for.

This module knows no ROS. `dashboard_node` fills a `Live` and offers the services; without ROS the page says so.
"""

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from tcbi_contract.safety import Mode
from tcbi_dashboard import torque
from tcbi_dashboard.torque import OLD_S, RELEASE, Torque, ago

WINDOW_S = 4.0
ALIVE_S = 1.0  # streams come at 5 Hz and more
POLICY_NODE, RECORDER_NODE = "policy_node", "recorder_node"
UP = "./tcbi up --robot sim"


@dataclasses.dataclass
class Topic:
    """Arrivals of one topic: the contract's rate (Hz, None for any) and the times at which messages came."""

    name: str
    expected_hz: float | None
    arrivals: deque[float] = dataclasses.field(default_factory=lambda: deque(maxlen=400))

    def rate_hz(self, now: float) -> float:
        """Messages per second over the last seconds."""
        recent = [t for t in self.arrivals if t > now - WINDOW_S]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 and recent[-1] > recent[0] else 0.0

    def age_s(self, now: float) -> float | None:
        """Seconds since the last message; None if there was none."""
        return now - self.arrivals[-1] if self.arrivals else None


@dataclasses.dataclass(frozen=True)
class Said:
    """What one source of the diagnostics said last, and when (monotonic s)."""

    level: int
    sentence: str
    heard: float


class Live:
    """The newest of everything; written by the node's thread, read by the page."""

    def __init__(self, fault: str = "") -> None:
        self.fault = fault  # why there is no graph to see, e.g. that ROS is missing
        self.lock = threading.Lock()
        self.topics: dict[str, Topic] = {}
        self.nodes: tuple[str, ...] = ()
        self.joint_names: tuple[str, ...] = ()
        self.joint_position: tuple[float, ...] = ()  # rad
        self.attitude: tuple[float, float, float, float] | None = None  # w x y z
        self.foot_names: tuple[str, ...] = ()
        self.contact: tuple[bool, ...] = ()
        self.diagnostics: dict[str, Said] = {}  # by source
        self.torque: Torque | None = None
        self.torque_heard = 0.0  # monotonic s
        self.rollout = ""  # id of the one in progress
        self.policy = ""  # id of the policy in use
        self.namespace = ""
        self.emergency_stop: Callable[[], str] = lambda: self.fault
        self.release: Callable[[], str] = lambda: self.fault
        self.reset: Callable[[], str] = lambda: self.fault
        self.load_policy: Callable[[str], str] = lambda _: self.fault
        self._closing: list[Callable[[], None]] = []

    def heard(self, topic: str) -> None:
        """A message of a topic has come."""
        with self.lock:
            self.topics[topic].arrivals.append(time.monotonic())

    def rates(self) -> list[tuple[str, float | None, float, float | None]]:
        """(topic, contract's rate Hz, rate seen Hz, age s) of each."""
        now = time.monotonic()
        with self.lock:
            return [(t.name, t.expected_hz, t.rate_hz(now), t.age_s(now)) for t in self.topics.values()]

    def diagnosed(self, source: str, level: int, sentence: str, values: Mapping[str, str]) -> None:
        """A source of the diagnostics has spoken."""
        with self.lock:
            self.diagnostics[source] = Said(level, sentence, time.monotonic())
        if told := Torque.of(values, sentence):
            self.note_torque(told)

    def note_torque(self, told: Torque) -> None:
        """The robot has said what its torque is: in its diagnostics, or as the answer to a button."""
        with self.lock:
            self.torque, self.torque_heard = told, time.monotonic()

    def shown_torque(self, motion: bool) -> torque.Shown:
        """What the page says of the torque; `motion` says whether it may move the robot."""
        with self.lock:
            return torque.shown(self.torque, time.monotonic() - self.torque_heard, motion)

    def age_s(self, topic: str) -> float | None:
        """Seconds since the last message of a topic; None if there was none."""
        with self.lock:
            return self.topics[topic].age_s(time.monotonic()) if topic in self.topics else None

    def there(self) -> bool:
        """Whether anything of a graph can be seen."""
        return bool(self.nodes) or any(age is not None and age < ALIVE_S for *_, age in self.rates())

    def last_word(self, node: str) -> str:
        """That a node which has spoken is silent now, and for how long; "" while it is not."""
        with self.lock:
            heard = [said.heard for source, said in self.diagnostics.items() if source.startswith(node)]
        silent = time.monotonic() - max(heard, default=time.monotonic())
        return f"{node} not heard for {ago(silent)}" if silent > OLD_S else ""

    def cannot_record(self) -> str:
        """Why no rollout can be recorded just now; "" where one can."""
        if not self.there():
            return self.fault or f"No robot's graph is running: start one, for instance with {UP}."
        if not any(node.endswith(f"/{RECORDER_NODE}") for node in self.nodes):
            return f"The graph has no {RECORDER_NODE}, so nothing can be recorded; {UP} starts one with it."
        with self.lock:
            stopped = self.torque is not None and self.torque.mode is Mode.STOPPED
        return f'The emergency stop stands: press "{RELEASE}" first.' if stopped else ""

    def on_close(self, what: Callable[[], None]) -> None:
        """Have something ended with the page."""
        self._closing.append(what)

    def close(self) -> None:
        """End the node."""
        for what in reversed(self._closing):
            what()
        self._closing.clear()
