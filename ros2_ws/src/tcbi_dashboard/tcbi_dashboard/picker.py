"""Which rollouts and which model version a view works on: one line on the page, and a list behind it."""

import asyncio
import math
import time
from collections.abc import Callable, Sequence

from nicegui import ui

from tcbi_dashboard.elements import soft, window, words
from tcbi_dashboard.session import Session
from tcbi_infer.bags.glance import Glance

COLUMNS = {
    "policy": "motion",
    "when": "recorded",
    "seen": "seen by the fit of",
    "task": "task",
    "source": "from",
    "slope": "slope / deg",
    "seconds": "length / s",
    "rollout": "rollout",
}
HOW_TO_RECORD = (
    "Record some, each motion twice, so that the robot can be compared with itself:",
    "`./tcbi up --robot sim`",
    "`./tcbi collect --policy gait:steps --n 2`",
    "Or start a collection on the Live view. Other folders of bags: ./tcbi dashboard FOLDER…",
)


class Picker:
    """The line with the choice; `changed` is called when it changes."""

    def __init__(self, session: Session, changed: Callable[[], None], model: bool = True) -> None:
        self.session, self.changed = session, changed
        self._seen: object = None
        with ui.element("div").classes("tcbi-row"):
            self.said = words("", "span").style("font-weight: 600")
            ui.button("Choose rollouts", on_click=self.open, icon="checklist").props("outline")
            self.model: ui.select | None = None
            if model:
                self.model = ui.select([], label="model", on_change=self._model).props("outlined dense options-dense")
        self.refresh()

    def refresh(self) -> None:
        """Show what is chosen now."""
        session = self.session
        state = (
            len(session.rollouts()),
            session.bench.catalogue.revision,
            tuple(session.versions()),
            session.version(),
        )
        if state == self._seen:
            return
        self._seen = state
        count, known = len(session.rollouts()), len(session.bench.catalogue.entries)
        self.said.set_content(f"{count} of {known} rollout{'s' * (known != 1)}")
        if self.model:
            self.model.set_options(session.versions(), value=session.version())

    def _model(self, event) -> None:
        if event.value and event.value != self.session.version():
            self.session.model = event.value
            self.changed()

    async def open(self) -> None:
        """The list of all rollouts."""
        seen = await asyncio.to_thread(self.session.seen_by)
        entries = self.session.bench.catalogue.entries
        rows = [row(e, seen.get(e.rollout_id, ())) for e in entries]
        chosen = {str(e.path) for e in self.session.rollouts()}
        columns = [
            {"name": c, "label": label, "field": c, "sortable": True, "align": "left"} for c, label in COLUMNS.items()
        ]
        with window("max-width: 1240px; width: 96vw") as dialog:
            words("Rollouts", "h2")
            soft(
                "A diagnosis needs several kinds of motion, six or more at best, each recorded twice. A version is "
                "judged on rollouts that its fit has not seen."
            )
            buttons = ui.element("div").classes("tcbi-row")
            grid = (
                ui.table(columns=columns, rows=rows, row_key="path", selection="multiple", pagination=12)
                .props("flat dense")
                .style("width: 100%; max-height: 60vh")
            )
            with ui.element("div").classes("tcbi-row"):
                use = ui.button(on_click=lambda: self._use(dialog, grid))
                ui.button("Cancel", on_click=dialog.close).props("flat")

            def count() -> None:
                chosen = len(usable(grid.selected))
                use.set_text(f"Use {chosen} rollout{'s' * (chosen != 1)}")

            def select(which: list[dict]) -> None:
                grid.selected = which
                grid.update()
                count()

            grid.on_select(count)
            with buttons:
                narrow = ui.input(placeholder="filter, e.g. gait:steps").props("dense outlined clearable")
                ui.button("All", on_click=lambda: select(matching(rows, narrow.value))).props("flat")
                ui.button("Newest 20", on_click=lambda: select(matching(rows, narrow.value)[:20])).props("flat")
                ui.button("None", on_click=lambda: select([])).props("flat")
            narrow.bind_value_to(grid, "filter", forward=lambda v: v or "")
            select([r for r in rows if r["path"] in chosen])

    def _use(self, dialog: ui.dialog, grid: ui.table) -> None:
        self.session.chosen = {r["path"] for r in usable(grid.selected)}
        dialog.close()
        self.refresh()
        self.changed()


def usable(rows: list[dict]) -> list[dict]:
    """The lines whose rollouts can be read."""
    return [r for r in rows if not r["problem"]]


def matching(rows: list[dict], text: str | None) -> list[dict]:
    """The lines that the filter shows: those with `text` in any column, in upper or lower case."""
    wanted = (text or "").lower()
    return [r for r in rows if any(wanted in str(r[column]).lower() for column in COLUMNS)]


def row(entry: Glance, seen: Sequence[str]) -> dict:
    """One line of the list; `seen` are the versions that were fitted to it."""
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.started)) if entry.started else "–"
    slope = math.degrees(math.hypot(entry.slope_roll, entry.slope_pitch))
    return {
        "path": str(entry.path),
        "when": when,
        "seen": ", ".join(seen) or "–",
        "rollout": entry.rollout_id,
        "policy": entry.policy_id or "–",
        "task": entry.problem or entry.task or "–",
        "source": entry.source or "–",
        "slope": f"{slope:.1f}",
        "seconds": "–" if entry.seconds is None else f"{entry.seconds:.1f}",
        "problem": entry.problem,
    }
