"""What all browsers share: the store, the list of rollouts, the jobs that run, and the results on disk.

The page holds no result of its own: a comparison or a diagnosis is a file of the store, made here or on the command
line, and the newest one is shown. So a page that is opened again, or in a second browser, shows the same.
"""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tcbi_dashboard.access import Access
from tcbi_dashboard.catalogue import Catalogue
from tcbi_dashboard.jobs import Slot
from tcbi_dashboard.names import COMPARISON, DIAGNOSIS, MOMENTS, SUMMARY
from tcbi_dashboard.task import DIAGNOSE, Task
from tcbi_sim.store import ModelStore


class Workbench:
    """The shared state; used from the server's own thread, but for `catalogue.look`."""

    def __init__(self, store: ModelStore, folders: Sequence[Path], access: Access) -> None:
        self.store, self.access = store, access
        self.catalogue = Catalogue(folders)
        self.work = Slot()  # whatever needs the processors: one thing at a time
        self.recording = Slot()  # a collection of rollouts, which needs hardly any
        self._diagnosis: Path | None = None
        os.environ["TCBI_STORE"] = str(store.root.absolute())  # workers look up the user's own effects there

    def poll(self) -> None:
        """Take in what the jobs have said."""
        self.work.poll()
        self.recording.poll()

    def close(self) -> None:
        """End the jobs."""
        self.work.close()
        self.recording.close()

    def task(self, kind: str, model: str = "latest", bags: Sequence[str] = (), **options: Any) -> Task:
        """A task on this store."""
        return Task(kind, str(self.store.root), model, tuple(bags), options)

    def comparison(self) -> Path | None:
        """Folder of the newest comparison."""
        return _newest(self.store.root / "runs", f"{COMPARISON}*/{SUMMARY}", lambda p: p.parent)

    def diagnosis(self) -> Path | None:
        """File of the newest diagnosis; one of this page counts once its job has ended, with its report."""
        job = self.work.job
        if not (job and job.task.kind == DIAGNOSE and not job.ended):
            self._diagnosis = _newest(self.store.root / "runs", f"{DIAGNOSIS}*.json", lambda p: p)
        return self._diagnosis

    def comparison_report(self) -> Path | None:
        """Report of the newest comparison."""
        folder = self.comparison()
        try:
            summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8")) if folder else {}
        except OSError:  # removed meanwhile
            return None
        path = self.store.root / "reports" / summary.get("report", "")
        return path if path.is_file() else None

    def moments(self, diagnosis: Path) -> list[dict[str, Any]]:
        """The worst moments of a diagnosis; none where only its JSON was brought here."""
        path = diagnosis.with_name(diagnosis.name.replace(DIAGNOSIS, MOMENTS))
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []

    def reports(self) -> list[Path]:
        """Every report in the store, newest first."""
        found = [*self.store.root.glob("reports/*.html"), *self.store.root.glob(f"runs/{DIAGNOSIS}*.html")]
        return sorted(found, key=lambda p: p.stat().st_mtime, reverse=True)


def _newest(folder: Path, pattern: str, what: Callable[[Path], Path]) -> Path | None:
    found = [(p.stat().st_mtime_ns, p) for p in folder.glob(pattern) if p.is_file()]
    return what(max(found)[1]) if found else None
