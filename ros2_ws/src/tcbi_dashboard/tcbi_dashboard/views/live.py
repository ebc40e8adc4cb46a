"""Live: the graph, the robot as it moves, emergency stop, a collection of rollouts."""

import asyncio
import math
from typing import Any

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_contract.names import JOINTS, SLOPE_LIMIT
from tcbi_dashboard import charts, task
from tcbi_dashboard.elements import RobotView, all_right, card, chart, empty, number_field, soft, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.session import RIG, Session
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.compare import skeleton_of
from tcbi_infer.collection import LONGEST_S
from tcbi_sim.rigs import load_rig

POSE_S = 0.1  # between two postures of the drawing
RANGE_DEG = 40.0  # a little more than the joints' own
LEVELS = {0: "fine", 1: "warning", 2: "error", 3: "stale"}
GAITS = ["gait:steps", "gait:sinus", "gait:chirp", "gait:squat", "gait:twist", "gait:tripod", "none"]
SLOPE_DEG = round(math.degrees(SLOPE_LIMIT), 9)
TOLERANCE = 0.15  # of the contract's rate


class LiveView(View):
    """The view; it draws only while it is seen."""

    def __init__(self, session: Session, live: Live) -> None:
        super().__init__(session)
        self.live = live
        self._tables: object = None
        self._posed: object = None
        self._there: bool | None = None

    def build(self) -> None:
        """Stop button first, then the robot, the rates, the nodes, a collection."""
        self.place = ui.element("div").style("width: 100%")
        with ui.element("div").classes("tcbi-grid"):
            with card("Robot", "two-thirds"):
                self.robot = RobotView(skeleton_of(RIG), "The robot as it stands now")
                self.said = words("", "p")
                self.feet = words("", "p", "tcbi-soft")
            with card("Stop", "third"):
                ui.button("EMERGENCY STOP", on_click=self.stop, color="#d55e00").classes("tcbi-stop").mark("stop")
                soft("Takes the torque off all joints at once. The robot will sink.")
                if self.bench.access.motion:
                    ui.button("Release the stop", on_click=self.release).props("outline")
                self.rollout = words("", "p")
                self.policy = words("", "p", "tcbi-soft")
            with card("Joints", "half"):
                self.joints = chart(charts.levels(JOINTS, "position / deg", RANGE_DEG), 420)
            with card("Topics and nodes", "half"):
                self.tables = ui.element("div").style("width: 100%")
            with card("Record rollouts"):
                self._collection()
        ui.timer(POSE_S, self._pose)

    def _collection(self) -> None:
        if not self.bench.access.motion:
            soft("This page may stop the robot, but not move it: start ./tcbi dashboard with --allow-motion for that.")
            return
        with ui.element("div").classes("tcbi-row"):
            self.task = ui.select(["balance", "forward"], value="balance", label="task")
            self.motion = ui.select(GAITS, value=GAITS[0], label="motion or policy", new_value_mode="add-unique")
            self.motion.props("use-input")
            for element in (self.task, self.motion):
                element.props("outlined dense options-dense stack-label")
            self.number = number_field("rollouts", 1, 1000, 1, whole=True)
            self.times = number_field("each so often", 1, 100, 2, whole=True)
            self.roll = number_field("slope, roll / deg", -SLOPE_DEG, SLOPE_DEG, unset="drawn")
            self.pitch = number_field("slope, pitch / deg", -SLOPE_DEG, SLOPE_DEG, unset="drawn")
            self.seconds = number_field("length / s", 0.2, LONGEST_S, unset="the task's own")
            self.seed = number_field("seed", 0, 2**32 - 1, 0, whole=True)
            ui.button("Record", on_click=self.record, icon="fiber_manual_record").mark("record")
        soft(
            "The robot moves. Each motion twice, on the same slope, shows what the robot differs from itself; a "
            "diagnosis needs five motions or more."
        )
        self.landed = words("", "p")

    async def stop(self) -> None:
        """Stop the robot."""
        ui.notify(await asyncio.to_thread(self.live.emergency_stop), type="warning", timeout=8000)

    async def release(self) -> None:
        """Let it stand up again."""
        ui.notify(await asyncio.to_thread(self.live.release))

    def record(self) -> None:
        """Start a collection."""
        if not all_right(self.number, self.times, self.roll, self.pitch, self.seconds, self.seed):
            return
        options: dict[str, Any] = {
            "task": self.task.value,
            "number": int(self.number.number or 1),
            "times": int(self.times.number or 1),
            "slope_roll": _radians(self.roll.number),
            "slope_pitch": _radians(self.pitch.number),
            "seed": int(self.seed.number or 0),
            "policy": self.motion.value or "",
            "duration_s": self.seconds.number or 0.0,
            "namespace": self.live.namespace.strip("/"),
        }
        try:
            self.bench.recording.start(self.bench.task(task.COLLECT, **options))
        except TcbiError as e:
            ui.notify(str(e), type="warning")

    def tick(self) -> None:
        """Twice a second while it is seen."""
        live = self.live
        with live.lock:
            names, position, attitude = live.joint_names, live.joint_position, live.attitude
            feet = [f for f, on in zip(live.foot_names, live.contact, strict=False) if on]
        rates = live.rates()
        alive = any(age is not None and age < 1.0 for *_, age in rates)
        self._say_who_is_there(bool(live.nodes) or alive)
        if alive and position:
            self.joints.options["series"][0]["data"] = [
                round(math.degrees(j), 2) for j in self._in_order(names, position)
            ]
            self.joints.update()
            self.said.set_content(_attitude(attitude))
            self.feet.set_content(f"On the ground: {', '.join(feet) or 'no foot'}")
        elif not alive:
            self.said.set_content("No joint states arrive.")
            self.feet.set_content("")
        self.rollout.set_content(f"Rollout in progress: {live.rollout}" if live.rollout else "No rollout in progress.")
        self.policy.set_content(f"Policy in use: {live.policy}" if live.policy else "")
        self._show_tables(rates)
        self._show_landed()

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
        self.place.clear()
        with self.place:
            if not there:
                empty(
                    "Nothing of a graph can be seen.",
                    self.live.fault or "Start one, on a simulation, the emulated robot or a real one:",
                    "`./tcbi up --robot sim`",
                )

    def _show_tables(self, rates: list[tuple[str, float | None, float, float | None]]) -> None:
        with self.live.lock:
            diagnostics = sorted(self.live.diagnostics.items())
        lines = [
            (name, f"{seen:.1f} Hz", f"{expected:g} Hz" if expected else "any", "–" if age is None else f"{age:.1f} s",
             bool(seen and expected and abs(seen - expected) > TOLERANCE * expected))
            for name, expected, seen, age in rates
        ]  # fmt: skip
        state = (lines, self.live.nodes, diagnostics)
        if state == self._tables:
            return
        self._tables = state
        self.tables.clear()
        with self.tables:
            with ui.element("div").classes("tcbi-live"):
                for head in ("topic", "rate", "contract", "age"):
                    words(head, "span", "tcbi-soft")
                for name, seen, expected, age, wrong in lines:
                    words(name, "span")
                    words(seen, "span", "tcbi-error" if wrong else "")
                    words(expected, "span")
                    words(age, "span")
            for source, (level, sentence) in diagnostics:
                words(f"{source}: {LEVELS.get(level, '?')}, {sentence}", "p", "tcbi-error" if level else "tcbi-soft")
            soft("Nodes: " + (", ".join(n.rpartition("/")[2] for n in self.live.nodes) or "none"))

    def _show_landed(self) -> None:
        job = self.bench.recording.job
        if job and job.result and self.bench.access.motion:
            count = len(job.result["bags"])
            self.landed.set_content(f"{count} rollout{'s' * (count != 1)} recorded; they are on the Compare view.")


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _attitude(quaternion: tuple[float, float, float, float] | None) -> str:
    if quaternion is None:
        return "No attitude arrives."
    w, x, y, z = quaternion
    roll = math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    pitch = math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))))
    return f"Roll {roll:.1f}°, pitch {pitch:.1f}°"
