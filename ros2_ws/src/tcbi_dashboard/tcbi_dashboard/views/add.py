"""Add and watch: one button adds an effect, the error falls version by version; undo, differences, posteriors."""

import asyncio
from pathlib import Path
from typing import Any

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_dashboard import charts, task, versions
from tcbi_dashboard.elements import card, chart, empty, soft, table, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.picker import Picker
from tcbi_dashboard.session import Session
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.retrain import RetrainCard
from tcbi_dashboard.views.why import read

SHOWN_PAIRS = 6


class AddView(View):
    """The view of the versions of one rig's model."""

    def __init__(self, session: Session, live: Live) -> None:
        super().__init__(session)
        self.retrain = RetrainCard(session, live, self.start)

    def build(self) -> None:
        """Candidates above, then the history, the versions, one version's posterior, the policy."""
        self.candidates = ui.element("div").classes("tcbi-grid")
        with card("The error, version by version"):
            self.history = ui.element("div").style("width: 100%")
            with self.history:
                soft("Reading the versions …")
            self.picker = Picker(self.session, lambda: None)
            with ui.element("div").classes("tcbi-row"):
                ui.button("Measure all versions on these", on_click=self.measure).props("outline").mark("measure")
                infer = ui.button("Infer the parameters from these", on_click=self.infer).props("outline")
                infer.tooltip("task-consistent Bayesian inference on the model chosen; makes a new version")
        self.details = ui.element("div").classes("tcbi-grid")
        with ui.element("div").classes("tcbi-grid"):
            self.retrain.build()

    def state(self) -> object:
        """What the view depends on."""
        job = self.bench.work.job
        return tuple(self.session.versions()), self.bench.diagnosis(), job.ended if job else None

    def tick(self) -> None:
        """Twice a second while it is seen."""
        self.picker.refresh()
        self.retrain.tick()
        super().tick()

    def report(self) -> Path | None:
        """Of the last change of the model, or of its versions' errors: whichever is newer."""
        kinds = ("add-", "remove-", "history-")
        return next((p for p in self.bench.reports() if p.name.startswith(kinds)), None)

    def refresh(self) -> None:
        """Show candidates at once; the versions follow."""
        self._show_candidates()
        ui.timer(0.01, self._show_versions, once=True)

    def measure(self) -> None:
        """Start measuring every version."""
        self.start(self.bench.task(task.HISTORY, self.session.version(), self.session.bags()))

    def infer(self) -> None:
        """Start an inference."""
        self.start(self.bench.task(task.INFER, self.session.version(), self.session.bags()))

    def _show_candidates(self) -> None:
        path = self.bench.diagnosis()
        found = read(path)
        self.candidates.clear()
        with self.candidates:
            if found is None:
                empty("No effect has been found yet.", "Diagnose first (Why): what it names can be added here.")
                return
            fitted = [e for e in found["ranking"] if e["refined"]]
            with card(f"Add an effect to {found['model']}"):
                words(found["statement"], "p")
                children = [v for v in self.session.versions() if v != found["model"]]
                with ui.element("div").classes("tcbi-row"):
                    for e in fitted[:4]:
                        named = e["use"] in found["uses"]
                        button = ui.button(f"Add {e['use']}", on_click=lambda use=e["use"]: self._add(found, path, use))
                        button.props("" if named else "outline").mark(f"add-{e['use']}")
                        if not e["accepted"]:
                            button.tooltip(f"not accepted: {e['reason']}")
                if not fitted:
                    soft("The diagnosis fitted no candidate, so there is nothing to add.")
                elif not any(e["accepted"] for e in fitted):
                    soft("None of these was accepted; a version made from one is a guess.")
                soft(f"Old versions stay{': ' + ', '.join(children) if children else ''}.")

    def _add(self, diagnosis: dict[str, Any], path: Any, use: str) -> None:
        self._start(self.bench.task(task.ADD, diagnosis["model"], use=use, diagnosis=str(path)))

    def _start(self, wanted: task.Task) -> None:
        try:
            self.bench.work.start(wanted)
        except TcbiError as e:
            ui.notify(str(e), type="warning")

    async def _show_versions(self) -> None:
        rig = self.session.rig()
        try:
            lines = await asyncio.to_thread(versions.errors, self.bench.store, rig)
        except TcbiError as e:
            ui.notify(str(e), type="warning")
            return
        self.history.clear()
        with self.history:
            self._show_history(lines)
        self.details.clear()
        with self.details:
            self._show_table(lines)
            self._show_difference([line["model"] for line in lines])
            self._show_posterior([line["model"] for line in lines])

    def _show_history(self, lines: list[dict[str, Any]]) -> None:
        if all(line["error"] is None for line in lines):
            soft("No version has been measured yet: choose rollouts that no fit has seen, then measure all versions.")
            return
        chart(charts.history([line["model"] for line in lines], [line["error"] for line in lines]), 280)
        counts = {line["rollouts"] for line in lines if line["rollouts"]}
        soft(
            f"Measured on {max(counts)} rollouts that no fit has seen; 1 is the robot against itself."
            if counts
            else "As the diagnoses measured it on motions that their fits had not seen; 1 is the robot against itself."
        )

    def _show_table(self, lines: list[dict[str, Any]]) -> None:
        with card("Versions", "half"), ui.element("div").classes("tcbi-versions"):
            for line in reversed(lines):
                words(line["model"], "strong")
                error = "not measured" if line["error"] is None else f"{charts.number(line['error'])} × floor"
                words(error, "span", "tcbi-version-error")
                made = {"diagnosis": "added", "remove": "effect removed"}.get(line["made"], line["made"])
                guess = ", not accepted: a guess" if line["accepted"] is False and line["made"] == "diagnosis" else ""
                words(f"{', '.join(line['effects']) or 'no effects'} ({made}{guess})", "span", "tcbi-soft")
                with ui.element("span"):
                    for use in line["effects"]:
                        ui.button(f"Take out {use}", on_click=lambda v=line["model"], u=use: self._remove(v, u)).props(
                            "flat dense"
                        ).mark(f"remove-{line['model']}-{use}")

    def _remove(self, version: str, use: str) -> None:
        self._start(self.bench.task(task.REMOVE, version, use=use))

    def _show_difference(self, known: list[str]) -> None:
        with card("What differs", "half"):
            if len(known) < 2:
                soft("There is one version only; add an effect, and the two can be compared here.")
                return
            with ui.element("div").classes("tcbi-row"):
                before = ui.select(known, value=known[0], label="before").props("outlined dense options-dense")
                after = ui.select(known, value=known[-1], label="after").props("outlined dense options-dense")
            place = ui.element("div").style("width: 100%")

            async def show() -> None:
                d = await asyncio.to_thread(versions.difference, self.bench.store, before.value, after.value)
                place.clear()
                with place:
                    _difference(d, before.value, after.value)

            before.on_value_change(show)
            after.on_value_change(show)
            ui.timer(0.05, show, once=True)

    def _show_posterior(self, known: list[str]) -> None:
        with card("What is known of the parameters"):
            version = ui.select(known, value=known[-1], label="version").props("outlined dense options-dense")
            version.style("max-width: 16rem")
            place = ui.element("div").classes("tcbi-grid")

            async def show() -> None:
                found = await asyncio.to_thread(versions.posterior, self.bench.store, version.value)
                place.clear()
                with place:
                    _posterior(found)

            version.on_value_change(show)
            ui.timer(0.1, show, once=True)


def _difference(d: dict[str, Any], before: str, after: str) -> None:
    words(d["statement"], "p")
    rows = [
        {
            "name": charts.with_unit(p["name"], p["unit"]),
            "before": _span(p["before"]),
            "after": _span(p["after"]),
            "overlap": charts.number(p["overlap"], 2),
        }
        for p in d["parameters"]
    ]
    heads = {"name": "parameter", "before": f"{before}: mean (90 %)", "after": after, "overlap": "overlap"}
    table(heads, rows, "name", pagination=0)


def _span(values: list[float] | None) -> str:
    if values is None:
        return "–"
    return f"{charts.number(values[0])} ({charts.number(values[1])} to {charts.number(values[2])})"


def _posterior(found: dict[str, Any]) -> None:
    told = {True: "told by the data", False: "little more than its prior", None: "not inferred"}
    with ui.element("div"):
        rows = [
            {
                "name": charts.with_unit(p["name"], p["unit"]),
                "value": _span([p["mean"], p["low90"], p["high90"]]),
                "told": told[p["identified"]],
            }
            for p in found["parameters"]
        ]
        table({"name": "parameter", "value": "mean (90 %)", "told": "do the data tell?"}, rows, "name", pagination=0)
    parameters = found["parameters"]
    pairs = [(a, b) for a in range(len(parameters)) for b in range(a)][:SHOWN_PAIRS]
    for a, b in pairs:
        points = [[round(row[b], 6), round(row[a], 6)] for row in found["draws"]]
        with ui.element("div").classes("tcbi-third"):
            chart(charts.pair(parameters[b], parameters[a], points), 250)
    steps = found["generations"]
    if steps:
        for p in parameters:
            if p["name"] not in steps["mean"]:
                continue
            mean, sd = steps["mean"][p["name"]], steps["sd"][p["name"]]
            series = {
                "mean": list(zip(steps["number"], mean, strict=True)),
                "one standard deviation above": [(g, m + s) for g, m, s in zip(steps["number"], mean, sd, strict=True)],
                "below": [(g, m - s) for g, m, s in zip(steps["number"], mean, sd, strict=True)],
            }
            with ui.element("div").classes("tcbi-third"):
                chart(charts.lines("generation", charts.with_unit(p["name"], p["unit"]), series), 240)
