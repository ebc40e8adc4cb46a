"""Reports: the self-contained files that the page and the command line write alike."""

import time

from nicegui import ui

from tcbi_dashboard.elements import card, empty, soft
from tcbi_dashboard.views.base import View


class ReportsView(View):
    """The view."""

    def build(self) -> None:
        """A list."""
        self.result = ui.element("div").classes("tcbi-grid")

    def state(self) -> object:
        """What the view depends on."""
        return tuple((p, p.stat().st_mtime_ns) for p in self.bench.reports())

    def refresh(self) -> None:
        """Show what is there."""
        self.result.clear()
        with self.result:
            reports = self.bench.reports()
            if not reports:
                empty("There are no reports yet.", "Every comparison, diagnosis and change of the model writes one.")
                return
            with card("Reports"):
                soft("Each is one file that needs nothing else: open it anywhere, send it to anybody.")
                with ui.element("div").classes("tcbi-reports"):
                    for path in reports:
                        status = path.stat()
                        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(status.st_mtime))
                        with ui.element("div"):
                            ui.link(path.stem, f"/report/{path.name}", new_tab=True)
                            soft(f"{when}, {status.st_size / 1000:.0f} kB, in {path.parent}")
                        ui.button("Save", on_click=lambda p=path: ui.download.file(p)).props("flat dense")
            with card("Pictures"):
                soft(
                    "The arrow at the top saves the view that is seen, as HTML or PNG; the button in the corner of a "
                    "3D drawing saves that drawing."
                )
