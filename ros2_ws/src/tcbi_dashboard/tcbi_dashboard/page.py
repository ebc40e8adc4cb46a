"""The page: a head with the views' names and the job that runs, and the view that is seen."""

import asyncio
from pathlib import Path

from nicegui import ui

from tcbi_dashboard.elements import words
from tcbi_dashboard.jobs import Slot
from tcbi_dashboard.live import Live
from tcbi_dashboard.session import Session
from tcbi_dashboard.views.add import AddView
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.compare import CompareView
from tcbi_dashboard.views.live import LiveView
from tcbi_dashboard.views.reports import ReportsView
from tcbi_dashboard.views.stop import StopAnywhere
from tcbi_dashboard.views.where import WhereView
from tcbi_dashboard.views.why import WhyView
from tcbi_dashboard.workbench import Workbench

TICK_S = 0.5
SNAPSHOT_S = 60.0  # for the browser to draw a view
FIRST = "Compare"
BROWSER = Path(__file__).parent / "browser"


def build(bench: Workbench, live: Live) -> None:
    """Register the page."""

    @ui.page("/")
    def root(view: str = "") -> None:
        Shell(bench, live).build(view)


async def look(bench: Workbench) -> None:
    """Look for new rollouts, in a thread."""
    await asyncio.to_thread(bench.catalogue.look)


class Shell:
    """One browser's page."""

    def __init__(self, bench: Workbench, live: Live) -> None:
        self.bench, self.live = bench, live
        self.session = Session(bench)
        self.session.go_to = self.show
        self.views: dict[str, View] = {
            "Live": LiveView(self.session, live),
            "Compare": CompareView(self.session),
            "Where": WhereView(self.session),
            "Why": WhyView(self.session, live),
            "Add": AddView(self.session, live),
            "Reports": ReportsView(self.session),
        }
        self._built: set[str] = set()
        self._jobs: object = None

    def build(self, first: str) -> None:
        """Head, panels, and the clock that keeps them up to date."""
        ui.add_css(BROWSER / "page.css")
        ui.add_head_html(f"<script>{(BROWSER / 'snapshot.js').read_text(encoding='utf-8')}</script>")
        ui.colors(primary="#0072b2")
        names = list(self.views)
        start = next((n for n in names if n.lower() == first.lower()), FIRST)
        dark = ui.dark_mode(None)

        async def turn() -> None:
            dark.set_value(not await ui.run_javascript("document.body.classList.contains('body--dark')"))

        with ui.element("header").classes("tcbi-head"):
            ui.html("tcbi", tag="h1", sanitize=False)
            with ui.tabs().props("dense no-caps align=left inline-label") as tabs:
                for name in names:
                    ui.tab(name)
            with ui.element("div").classes("tcbi-tools"):
                self.stop = StopAnywhere(self.live)
                with ui.button(icon="download").props("flat round dense aria-label='save this view'"), ui.menu():
                    ui.menu_item("Save this view as HTML", self._save_html)
                    ui.menu_item("Save this view as PNG", lambda: self._snapshot("png"))
                ui.button(icon="contrast", on_click=turn).props("flat round dense aria-label='light or dark'")
            self.jobs = ui.element("div").classes("tcbi-jobs")
        self.tabs = tabs
        with (
            ui.element("main").classes("tcbi-main"),
            ui.tab_panels(tabs, value=start, animated=False).props("keep-alive"),
        ):
            self.panels = {}
            for name in names:
                with ui.tab_panel(name).classes("tcbi-view") as panel:
                    self.panels[name] = panel
        self._see(start)
        tabs.on_value_change(self._changed)
        ui.timer(TICK_S, self.tick)
        if first and first.lower() != start.lower():
            ui.notify(f'There is no view "{first}". The views are {", ".join(names)}.', type="warning")

    def show(self, name: str) -> None:
        """Go to a view."""
        self.tabs.set_value(name)

    async def _save_html(self) -> None:
        """The report that the command line writes of the same, or the view itself where there is none."""
        report = self.views[self.tabs.value].report()
        if report:
            ui.download.file(report)
        else:
            await self._snapshot("html")

    async def _snapshot(self, kind: str) -> None:
        view = self.tabs.value
        try:
            wrong = await ui.run_javascript(f"return await tcbiSnapshot({kind!r}, {view!r})", timeout=SNAPSHOT_S)
        except TimeoutError:
            wrong = f"the browser took more than {SNAPSHOT_S:g} s"
        if wrong:
            other = {"png": "HTML", "html": "PNG"}[kind]
            ui.notify(f"{view} could not be saved ({wrong}); save it as {other} instead.", type="negative")

    def _changed(self, event) -> None:
        self._see(event.value)
        ui.navigate.history.replace(f"/?view={event.value.lower()}")

    def _see(self, name: str) -> None:
        self.session.seen = name
        if name not in self._built:
            self._built.add(name)
            with self.panels[name]:
                self.views[name].build()
        self.views[name].tick()

    def tick(self) -> None:
        """Keep the head and the view that is seen up to date."""
        self._show_job()
        self.stop.tick()
        self.views[self.tabs.value].tick()

    def _show_job(self) -> None:
        state = tuple(job.state for job in (self.bench.work.job, self.bench.recording.job) if job)
        if state == self._jobs:
            return
        self._jobs = state
        self.jobs.clear()
        with self.jobs:
            for slot in (self.bench.work, self.bench.recording):
                if slot.job and slot.job.line:
                    with ui.element("div").classes("tcbi-job"):
                        _job(slot)


def _job(slot: Slot) -> None:
    """One line: what is being done, how far it is, and how to end it; or how it ended, until somebody has read it."""
    job = slot.job
    assert job is not None
    words(job.line, "span", "tcbi-error" if job.failed else "")
    if job.ended:
        ui.button("Dismiss", on_click=slot.dismiss).props("flat dense").mark("dismiss")
        return
    bar = ui.linear_progress(job.share or 0.0, show_value=False)
    if job.share is None:
        bar.props("indeterminate")
    ui.button("Cancel", on_click=slot.cancel).props("flat dense").mark("cancel")
