"""Recording rollouts with the running graph: the form on Live, and where the recordings went."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_contract.names import SLOPE_LIMIT
from tcbi_dashboard import task
from tcbi_dashboard.elements import all_right, card, number_field, say, soft, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.torque import NO_LEAVE
from tcbi_dashboard.workbench import Workbench
from tcbi_infer.collection import LONGEST_S
from tcbi_sim.tasks import tasks

GAITS = ["gait:steps", "gait:sinus", "gait:chirp", "gait:squat", "gait:twist", "gait:tripod", "none"]
SLOPE_DEG = round(math.degrees(SLOPE_LIMIT), 9)


class RecordCard:
    """The card."""

    def __init__(self, bench: Workbench, live: Live) -> None:
        self.bench, self.live = bench, live

    def build(self) -> None:
        """The form, or that this page may not move the robot."""
        with card("Record rollouts"):
            if not self.bench.access.motion:
                soft(NO_LEAVE)
                return
            with ui.element("div").classes("tcbi-row"):
                known = list(tasks())
                self.task = ui.select(known, value=known[0], label="task")
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
        }
        start_recording(self.bench, self.live, **options)

    def tick(self) -> None:
        """Twice a second while it is seen."""
        job = self.bench.recording.job
        if self.bench.access.motion and job and (job.result or job.failed):
            catalogue = self.bench.catalogue
            bags = (job.result or {}).get("bags", [])
            say(self.landed, landed([Path(bag) for bag in bags], catalogue.added))


def start_recording(bench: Workbench, live: Live, **options: Any) -> None:
    """Start a collection with the running graph, or say at once why not."""
    if refused := live.cannot_record():
        ui.notify(refused, type="warning", multi_line=True, timeout=8000)
        return
    try:
        bench.recording.start(bench.task(task.COLLECT, namespace=live.namespace.strip("/"), **options))
    except TcbiError as e:
        ui.notify(str(e), type="warning")


def landed(bags: Sequence[Path], added: Sequence[Path]) -> str:
    """Where recordings went.

    Args:
      bags: their files.
      added: folders that the page reads only since something was recorded into them.
    """
    if not bags:
        return "Nothing was recorded."
    folder = bags[0].parent
    what = f"{len(bags)} rollout{'s' * (len(bags) != 1)} recorded in {folder}"
    they = "they are" if len(bags) > 1 else "it is"
    if not bags[0].exists():
        return f"{what} on another computer; copy that folder to this one, and name it: ./tcbi dashboard FOLDER"
    if folder in added:
        return (
            f"{what}; {they} on the Compare view. That folder was none of this page's: it stays until the page's "
            f"server ends. To have it next time: ./tcbi dashboard {folder}"
        )
    return f"{what}; {they} on the Compare view."


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)
