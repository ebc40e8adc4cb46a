"""What all views have in common: they are built when first seen, and redrawn when what they depend on has changed."""

from pathlib import Path

from nicegui import ui

from tcbi_contract.errors import TcbiError
from tcbi_dashboard.session import Session
from tcbi_dashboard.task import Task
from tcbi_dashboard.workbench import Workbench


class View:
    """One view of one browser."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._shown: object = self  # no state is ever equal to it

    @property
    def bench(self) -> Workbench:
        """What all browsers share."""
        return self.session.bench

    def build(self) -> None:
        """Make the elements, once."""

    def state(self) -> object:
        """What the view depends on; a new value has it redrawn."""
        return None

    def refresh(self) -> None:
        """Redraw."""

    def report(self) -> Path | None:
        """The report of what the view shows, as the command line writes it; None where there is none."""
        return None

    def tick(self) -> None:
        """Called twice a second while the view is seen."""
        state = self.state()
        if state != self._shown:
            self._shown = state
            self.refresh()

    def start(self, task: Task) -> None:
        """Start a job on some rollouts, or say why not."""
        if not task.bags:
            ui.notify("No rollouts are chosen; choose some first.", type="warning")
            return
        try:
            self.bench.work.start(task)
        except TcbiError as e:
            ui.notify(str(e), type="warning")
