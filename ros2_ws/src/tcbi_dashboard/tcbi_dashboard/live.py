"""The graph as the page sees it: what a node in a background thread has heard, and what it may be asked for.

This module knows no ROS. `dashboard_node` fills a `Live` and offers the services; without ROS the page says so.
"""

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable

WINDOW_S = 4.0


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
        self.diagnostics: dict[str, tuple[int, str]] = {}  # source -> level, sentence
        self.rollout = ""  # id of the one in progress
        self.policy = ""  # id of the policy in use
        self.namespace = ""
        self.emergency_stop: Callable[[], str] = lambda: self.fault
        self.release: Callable[[], str] = lambda: self.fault
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

    def on_close(self, what: Callable[[], None]) -> None:
        """Have something ended with the page."""
        self._closing.append(what)

    def close(self) -> None:
        """End the node."""
        for what in reversed(self._closing):
            what()
        self._closing.clear()
