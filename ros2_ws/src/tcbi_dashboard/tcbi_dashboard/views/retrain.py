"""Retrain the policy on a version's posterior, follow its curve, swap it in."""

import asyncio
from collections.abc import Callable

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_dashboard import charts, task
from tcbi_dashboard.elements import card, chart, soft, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.session import Session

TASKS = ["balance", "forward"]
BUDGET_S = 120


class RetrainCard:
    """The card."""

    def __init__(self, session: Session, live: Live, start: Callable[[task.Task], None]) -> None:
        self.session, self.live, self._start = session, live, start
        self._shown: object = None

    def build(self) -> None:
        """What to train, and the result."""
        with card("Retrain the policy"):
            soft(
                "The successor trains on draws from the posterior. It is kept only if it is better, with 95 % "
                "confidence, on draws that the training has not seen."
            )
            with ui.element("div").classes("tcbi-row"):
                self.task = ui.select(TASKS, value=TASKS[0], label="task", on_change=self._policies)
                self.policy = ui.select([], label="to beat")
                self.budget = ui.number("time for training / s", value=BUDGET_S, min=10, max=86400, step=10)
                for element in (self.task, self.policy, self.budget):
                    element.props("outlined dense options-dense")
                ui.button("Retrain", on_click=self.retrain).props("outline")
            self.result = ui.element("div").style("width: 100%")
        self._policies()

    def _policies(self) -> None:
        from tcbi_policy.artefact import policy_paths

        names = [n for n in policy_paths(self.session.bench.store.root) if n.startswith(self.task.value)]
        self.policy.set_options(names, value=names[-1] if names else None)

    def retrain(self) -> None:
        """Start a retraining."""
        bench = self.session.bench
        if not self.policy.value:
            ui.notify(f"No policy for {self.task.value} exists; make one with ./tcbi train --task {self.task.value}.")
            return
        wanted = bench.task(
            task.RETRAIN, self.session.version(), task=self.task.value, policy=self.policy.value,
            budget_s=float(self.budget.value or BUDGET_S),
        )  # fmt: skip
        try:
            bench.work.start(wanted)
        except TcbiError as e:
            ui.notify(str(e), type="warning")

    def tick(self) -> None:
        """Show how a retraining goes."""
        job = self.session.bench.work.job
        state = (id(job), len(job.training), job.ended) if job and job.task.kind == task.RETRAIN else None
        if state == self._shown or job is None or state is None:
            return
        self._shown = state
        self.result.clear()
        with self.result:
            if job.training:
                points = [(e["steps"], e["mean_return"]) for e in job.training]
                chart(charts.lines("control steps", "mean return", {"mean return": points}), 240)
            if job.result:
                words(job.result["message"], "p")
                if job.result["accepted"]:
                    self._offer(job.result["reference"])
                self._policies()

    def _offer(self, name: str) -> None:
        if not self.session.bench.access.motion:
            soft("This page may not move the robot (./tcbi dashboard --allow-motion), so it cannot swap a policy in.")
            return

        async def swap() -> None:
            ui.notify(await asyncio.to_thread(self.live.load_policy, name) or "done")

        ui.button(f"Swap {name} in", on_click=swap)
