"""Add and watch: one button adds an effect, each version's error beside its parent's; undo, differences, posteriors."""

import asyncio
from collections.abc import Sequence
from typing import Any

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_dashboard import charts, task, versions
from tcbi_dashboard.ask import ask
from tcbi_dashboard.elements import card, chart, empty, notes, soft, words
from tcbi_dashboard.error_line import ErrorLine, Point
from tcbi_dashboard.live import Live
from tcbi_dashboard.picker import Picker
from tcbi_dashboard.session import Session
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.parameters import show_difference, show_posterior
from tcbi_dashboard.views.retrain import RetrainCard
from tcbi_dashboard.views.why import read
from tcbi_infer.diagnose.adopt import objection

NAMED_ROLLOUTS = 12  # of those a measurement used, on the page


class AddView(View):
    """The view of the versions of one rig's model."""

    def __init__(self, session: Session, live: Live) -> None:
        super().__init__(session)
        self._shown_version = ""  # to look at; the newest unless one was asked for
        self._known: list[str] = []  # versions
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
        ended = job.ended if job else None
        return tuple(self.session.versions()), self.bench.diagnosis(), ended

    def tick(self) -> None:
        """Twice a second while it is seen."""
        self.picker.refresh()
        self.retrain.tick()
        super().tick()

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
                refused = {e["use"]: told for e in fitted[:4] if (told := objection(found, e["use"]))}
                with ui.element("div").classes("tcbi-row"):
                    for e in (e for e in fitted[:4] if e["use"] not in refused):
                        named = e["use"] in found["uses"]
                        button = ui.button(f"Add {e['use']}", on_click=lambda use=e["use"]: self._add(found, path, use))
                        button.props("" if named else "outline").mark(f"add-{e['use']}")
                        if not e["accepted"]:
                            button.tooltip(f"not accepted: {e['reason']}")
                for told in refused.values():
                    words(f"{told}.", "p")
                if not fitted:
                    soft("The diagnosis fitted no candidate, so there is nothing to add.")
                elif not any(e["accepted"] for e in fitted):
                    soft("None of these was accepted; a version made from one is a guess.")
                soft(f"Old versions stay{': ' + ', '.join(children) if children else ''}.")

    async def _add(self, diagnosis: dict[str, Any], path: Any, use: str) -> None:
        """Add an effect; ask first where a version has it already."""
        parent = diagnosis["model"]
        same, others = await asyncio.to_thread(versions.already, self.bench.store, diagnosis, use)

        def add() -> None:
            self._start(self.bench.task(task.ADD, parent, use=use, diagnosis=str(path)))

        if same:
            told = [f"{same[-1]} is {parent} with {use} already, from this very diagnosis: another would be a copy."]
            look = (f"Show {same[-1]}", lambda: self._look_at(same[-1]))
            ask(f"{same[-1]} has it", told, [look, ("Add a copy", add)])
        elif others:
            told = [
                f"{others[-1]} is {parent} with {use} too, as another diagnosis fitted it.",
                f"The new version takes what this diagnosis fitted; {others[-1]} stays.",
            ]
            look = (f"Show {others[-1]}", lambda: self._look_at(others[-1]))
            ask(f"Add {use} to {parent} once more?", told, [("Add it", add), look])
        else:
            add()

    def _look_at(self, version: str) -> None:
        self._shown_version = version
        self._show_parameters()
        ui.notify(f"What is known of {version} is shown below.")

    def _start(self, wanted: task.Task) -> None:
        try:
            self.bench.work.start(wanted)
        except TcbiError as e:
            ui.notify(str(e), type="warning")
        else:
            self._shown_version = ""

    async def _show_versions(self) -> None:
        store, rig = self.bench.store, self.session.rig()
        try:
            line, what = await asyncio.to_thread(versions.errors, store, rig)
        except TcbiError as e:
            ui.notify(str(e), type="warning")
            return
        self._known = [p.model for p in line.points]
        self.history.clear()
        with self.history:
            self._show_history(line)
        self.details.clear()
        with self.details:
            self._show_table(line, what)
            self.parameters = ui.element("div").classes("tcbi-same")
        self._show_parameters()

    def _show_parameters(self) -> None:
        store, known = self.bench.store, self._known
        if not known:  # nothing has been drawn yet
            return
        chosen = self._shown_version if self._shown_version in known else known[-1]
        self.parameters.clear()
        with self.parameters:
            show_difference(store, known, chosen)
            show_posterior(store, known, chosen)

    def _show_history(self, line: ErrorLine) -> None:
        if not line.source:
            soft("No version has been measured yet: choose rollouts that no fit has seen, then measure all versions.")
            return
        chart(charts.history({p.model: p.error for p in line.points}, {p.model: p.parent for p in line.points}), 290)
        soft(f"{line.source} A line joins a version with the one it was made from.")
        notes(line.notes)
        if line.used:
            soft(f"Measured on: {_few(line.used)}.")
        if line.not_counted:
            with ui.expansion(f"{len(line.not_counted)} that do not count").style("width: 100%"):
                soft(f"{', '.join(line.not_counted)}.")

    def _show_table(self, line: ErrorLine, what: dict[str, tuple[tuple[str, ...], str]]) -> None:
        with card("Versions", "half"), ui.element("div").classes("tcbi-versions"):
            for point in reversed(line.points):
                words(point.model, "strong")
                words(_figure(point), "span", "tcbi-version-error")
                effects, made = what[point.model]
                words(f"{', '.join(effects) or 'no effects'} ({made})", "span", "tcbi-soft")
                with ui.element("span"):
                    for use in effects:
                        ui.button(
                            f"Take out {use}", on_click=lambda v=point.model, u=use: self._take_out(v, u, line)
                        ).props("flat dense").mark(f"remove-{point.model}-{use}")

    def _take_out(self, version: str, use: str, line: ErrorLine) -> None:
        newest = line.points[-1].model
        rig, _, number = newest.rpartition("-v")
        made = f"{rig}-v{int(number) + 1}"
        told = [
            f"This makes {made}: {version} without {use}. {version} stays.",
            f"{made} is then the newest version, which commands and this page take unless another one is named.",
            "Its other parameters keep the values that they took beside the effect: measure it, or fit it again.",
        ]
        ask(f"Take {use} out of {version}?", told, [(f"Make {made} without {use}", lambda: self._remove(version, use))])

    def _remove(self, version: str, use: str) -> None:
        self._start(self.bench.task(task.REMOVE, version, use=use))


def _figure(point: Point) -> str:
    """A version's error, or in two words that it has none; the sentences under the chart say why."""
    if point.error is not None:
        return f"{charts.number(point.error)} × floor"
    return "not judged" if point.seen else "not measured"


def _few(names: Sequence[str]) -> str:
    more = len(names) - NAMED_ROLLOUTS
    return ", ".join(names[:NAMED_ROLLOUTS]) + (f" and {more} more" if more > 0 else "")
