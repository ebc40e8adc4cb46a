"""Live: the graph, the robot as it moves, emergency stop, a collection of rollouts."""

import math
import time

from nicegui import ui

from tcbi_contract.names import JOINT_STATES, JOINTS
from tcbi_dashboard import charts
from tcbi_dashboard.elements import RobotView, card, chart, empty, say, soft, words
from tcbi_dashboard.live import ALIVE_S, UP, Live, Said
from tcbi_dashboard.session import RIG, Session
from tcbi_dashboard.torque import OLD_S, ago, in_page_words
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.compare import skeleton_of
from tcbi_dashboard.views.record import RecordCard
from tcbi_dashboard.views.stop import StopCard
from tcbi_sim.rigs import load_rig

POSE_S = 0.1  # between two postures of the drawing
RANGE_DEG = 40.0  # a little more than the joints' own
LEVELS = {0: "fine", 1: "warning", 2: "error", 3: "stale"}
TOLERANCE = 0.15  # of the contract's rate


class LiveView(View):
    """The view; it draws only while it is seen."""

    def __init__(self, session: Session, live: Live) -> None:
        super().__init__(session)
        self.live = live
        self._stop = StopCard(live, session.bench.access.motion)
        self._record = RecordCard(session.bench, live)
        self._tables: object = None
        self._posed: object = None
        self._there: bool | None = None

    def build(self) -> None:
        """Stop button first, then the robot, the rates, the nodes, a collection."""
        self.place = ui.element("div").style("width: 100%")
        with ui.element("div").classes("tcbi-grid"):
            with card("Robot", "two-thirds") as self.robot_card:
                self.robot = RobotView(skeleton_of(RIG), "The robot as it stands now")
                self.said = words("", "p")
                self.feet = words("", "p", "tcbi-soft")
            self._stop.build()
            with card("Joints", "half") as self.joint_card:
                self.joints = chart(charts.levels(JOINTS, "position / deg", RANGE_DEG), 420)
            with card("Topics and nodes", "half"):
                self.tables = ui.element("div").style("width: 100%")
            self._record.build()
        ui.timer(POSE_S, self._pose)

    def tick(self) -> None:
        """Twice a second while it is seen."""
        live = self.live
        with live.lock:
            names, position, attitude = live.joint_names, live.joint_position, live.attitude
            feet = [f for f, on in zip(live.foot_names, live.contact, strict=False) if on]
        self._say_who_is_there(live.there())
        age = live.age_s(JOINT_STATES)
        alive = age is not None and age < ALIVE_S
        for place in (self.robot_card, self.joint_card):
            place.classes(**{"remove" if alive else "add": "tcbi-old"})
        if alive:
            self.joints.options["series"][0]["data"] = [
                round(math.degrees(j), 2) for j in self._in_order(names, position)
            ]
            self.joints.update()
            say(self.said, _attitude(attitude))
            say(self.feet, f"On the ground: {', '.join(feet) or 'no foot'}")
        else:
            last = "" if age is None else f" This is how the robot stood {ago(age)} ago."
            say(self.said, f"No joint states arrive.{last}")
            say(self.feet, "")
        self._stop.tick()
        self._record.tick()
        self._show_tables()

    def _pose(self) -> None:
        """Move the drawing, ten times a second while it is seen and something new has come."""
        with self.live.lock:
            now = (self.live.joint_names, self.live.joint_position, self.live.attitude)
        if self.session.seen != "Live" or not now[1] or now == self._posed:
            return
        self._posed = now
        names, position, attitude = now
        base = [0.0, 0.0, load_rig(RIG).stand_height, *(attitude or (1.0, 0.0, 0.0, 0.0))]
        self.robot.pose(base, self._in_order(names, position))

    @staticmethod
    def _in_order(names: tuple[str, ...], position: tuple[float, ...]) -> list[float]:
        by_name = dict(zip(names, position, strict=False))
        return [by_name.get(n, 0.0) for n in JOINTS]

    def _say_who_is_there(self, there: bool) -> None:
        if there == self._there:
            return
        self._there = there
        self.place.set_visibility(not there)
        self.place.clear()
        with self.place:
            if not there:
                empty(
                    "Nothing of a graph can be seen.",
                    self.live.fault or "Start one, on a simulation, the emulated robot or a real one:",
                    f"`{UP}`",
                )

    def _show_tables(self) -> None:
        with self.live.lock:
            said = sorted(self.live.diagnostics.items())
        lines = [
            (name, f"{seen:.1f} Hz", f"{expected:g} Hz" if expected else "any", "–" if age is None else f"{age:.1f} s",
             bool(seen and expected and abs(seen - expected) > TOLERANCE * expected), age is None or age > OLD_S)
            for name, expected, seen, age in self.live.rates()
        ]  # fmt: skip
        health = [diagnosis_line(source, what, time.monotonic() - what.heard) for source, what in said]
        state = (lines, self.live.nodes, health)
        if state == self._tables:
            return
        self._tables = state
        self.tables.clear()
        with self.tables:
            with ui.element("div").classes("tcbi-live"):
                for head in ("topic", "rate", "contract", "age"):
                    words(head, "span", "tcbi-soft")
                for name, *cells, wrong, old in lines:
                    words(name, "span", "tcbi-old" if old else "")
                    for i, cell in enumerate(cells):
                        words(cell, "span", "tcbi-old" if old else "tcbi-error" if wrong and i == 0 else "")
            for line, look in health:
                words(line, "p", look)
            soft("Nodes: " + (", ".join(n.rpartition("/")[2] for n in self.live.nodes) or "none"))


def diagnosis_line(source: str, said: Said, age_s: float) -> tuple[str, str]:
    """What a source of the diagnostics said last, and its look: what is old says so, and is no alarm any more."""
    told = f"{LEVELS.get(said.level, '?')}, {in_page_words(said.sentence)}"
    if age_s > OLD_S:
        return f"{source}: not heard for {ago(age_s)} (then: {told})", "tcbi-old"
    return f"{source}: {told}", "tcbi-error" if said.level else "tcbi-soft"


def _attitude(quaternion: tuple[float, float, float, float] | None) -> str:
    if quaternion is None:
        return "No attitude arrives."
    w, x, y, z = quaternion
    roll = math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    pitch = math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))))
    return f"Roll {roll:.1f}°, pitch {pitch:.1f}°"
