"""Retrain the policy on a version's posterior, follow its curve, swap it in; what earlier retrainings came to."""

import asyncio
from collections.abc import Callable

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_dashboard import charts, retrainings, task
from tcbi_dashboard.elements import all_right, card, chart, number_field, soft, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.retrainings import KEPT, Retraining
from tcbi_dashboard.session import Session
from tcbi_sim.tasks import tasks

BUDGET_S = 120.0
SHOWN = 20  # earlier retrainings


class RetrainCard:
    """The card."""

    def __init__(self, session: Session, live: Live, start: Callable[[task.Task], None]) -> None:
        self.session, self.live, self._start = session, live, start
        self._shown: object = None
        self._listed: object = None

    def build(self) -> None:
        """What to train, the result, and what the store holds of earlier ones."""
        with card("Retrain the policy"):
            soft(
                "The successor trains on draws from the posterior of the model chosen above. It is kept only if it is "
                "better, with 97.5 % confidence at the first attempt and more at each further one, on draws that the "
                "training has not seen. A training that was cancelled goes on where it stopped when the same is asked "
                "for again with the same code."
            )
            with ui.element("div").classes("tcbi-row"):
                known = list(tasks())
                self.task = ui.select(known, value=known[0], label="task", on_change=self._policies)
                self.policy = ui.select([], label="to beat")
                for element in (self.task, self.policy):
                    element.props("outlined dense options-dense stack-label")
                self.budget = number_field("time for training / s", 10, 86400, BUDGET_S)
                ui.button("Retrain", on_click=self.retrain).props("outline")
            self.result = ui.element("div").style("width: 100%")
            self.earlier = ui.element("div").style("width: 100%")
        self._policies()

    def _policies(self) -> None:
        names = retrainings.policies(self.session.bench.store.root, self.task.value)
        self.policy.set_options(names, value=names[-1] if names else None)

    def retrain(self) -> None:
        """Start a retraining."""
        bench = self.session.bench
        if not all_right(self.budget):
            return
        if not self.policy.value:
            ui.notify(f"No policy for {self.task.value} exists; make one with ./tcbi train --task {self.task.value}.")
            return
        wanted = bench.task(
            task.RETRAIN, self.session.version(), task=self.task.value, policy=self.policy.value,
            budget_s=self.budget.number,
        )  # fmt: skip
        try:
            bench.work.start(wanted)
        except TcbiError as e:
            ui.notify(str(e), type="warning")

    def tick(self) -> None:
        """Show how a retraining goes, and what has come of the earlier ones."""
        job = self.session.bench.work.job
        state = (id(job), len(job.training), job.ended) if job and job.task.kind == task.RETRAIN else None
        if job is not None and state is not None and state != self._shown:
            self._shown = state
            self.result.clear()
            with self.result:
                if job.training and not job.ended:
                    chart(_curve([(e["steps"], e["mean_return"]) for e in job.training]), 240)
                if job.result:
                    words(job.result["message"], "p")
        root = self.session.bench.store.root
        listed = (state, *(_changed(root / folder) for folder in ("policies", "runs")))
        if listed != self._listed:
            self._listed = listed
            self._policies()
            self._show_earlier(retrainings.retrainings(root))

    def _show_earlier(self, found: list[Retraining]) -> None:
        self.earlier.clear()
        if not found:
            return
        with self.earlier:
            words("Trained so far", "strong")
            for one in found[:SHOWN]:
                self._show(one)
            if len(found) > SHOWN:
                soft(f"and {len(found) - SHOWN} older ones")

    def _show(self, one: Retraining) -> None:
        against = f", against {one.rival}" if one.rival else ""
        on = f" on {one.model}" if one.model else ""
        when = f", {one.created[:16].replace('T', ' ')} UTC" if one.created else ""
        title = one.name if one.ended == KEPT else one.task
        with ui.element("div").style("padding: .4rem 0"):
            with ui.element("div").classes("tcbi-row"):
                words(f"{title}: {one.ended}", "strong")
                words(f"{one.task}{on}{against}{when}", "span", "tcbi-soft")
                if one.ended == KEPT:
                    self._offer(one.name)
            soft(f"{one.said[0].upper()}{one.said[1:]}." if not one.said.endswith(".") else one.said)
            if one.curve:
                _folded(one)

    def _offer(self, name: str) -> None:
        if not self.session.bench.access.motion:
            words("Swapping it in needs ./tcbi dashboard --allow-motion", "span", "tcbi-soft")
            return

        async def swap() -> None:
            ui.notify(await asyncio.to_thread(self.live.load_policy, name) or "done")

        ui.button(f"Swap {name} in", on_click=swap).props("outline")


def _folded(one: Retraining) -> None:
    """The curve, drawn once somebody looks."""
    with ui.expansion("Curve of the training").style("width: 100%") as fold:
        place = ui.element("div").style("width: 100%")

    def draw() -> None:
        if fold.value and not place.default_slot.children:
            with place:
                chart(_curve(list(one.curve)), 240)

    fold.on_value_change(draw)


def _curve(points: list[tuple[float, float]]) -> dict:
    return charts.lines("control steps", "mean return", {"mean return": points})


def _changed(folder) -> float:
    return folder.stat().st_mtime if folder.is_dir() else 0.0
