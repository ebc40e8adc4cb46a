"""One job at a time in a process of its own: started, watched without waiting, cancelled."""

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

from tcbi_dashboard.errors import DashboardError
from tcbi_dashboard.task import ADD, COLLECT, COMPARE, DIAGNOSE, HISTORY, INFER, MODULE, REMOVE, RETRAIN, Task
from tcbi_dashboard.torque import in_page_words
from tcbi_infer.worker_process import Worker

TITLES = {
    COMPARE: "Comparing",
    DIAGNOSE: "Diagnosing",
    HISTORY: "Measuring the versions",
    ADD: "Adding an effect",
    REMOVE: "Taking an effect out",
    INFER: "Inferring the parameters",
    RETRAIN: "Retraining",
    COLLECT: "Recording",
}


@dataclasses.dataclass
class Job:
    """A job in progress, and how it ended."""

    task: Task
    began: float  # monotonic s
    stage: str = ""
    share: float | None = None
    remaining_s: float | None = None
    training: list[dict[str, Any]] = dataclasses.field(default_factory=list)  # events of a training
    result: dict[str, Any] | None = None
    failed: str = ""
    cancelled: bool = False
    ended: bool = False
    dismissed: bool = False  # somebody has read how it ended

    @property
    def title(self) -> str:
        """What is being done."""
        return TITLES[self.task.kind]

    @property
    def spent_s(self) -> float:
        """Seconds since its start."""
        return time.monotonic() - self.began

    @property
    def line(self) -> str:
        """What the head of the page says of it; "" where there is nothing to say (any more)."""
        if self.dismissed or (self.ended and not self.failed and not self.cancelled):
            return ""
        if self.failed:
            return f"{self.title} failed: {in_page_words(self.failed)}"
        if self.cancelled:
            return f"{self.title} was cancelled."
        spent = f"running for {self.spent_s:.0f} s"
        left = f"about {self.remaining_s:.0f} s left in all" if (self.remaining_s or 0) >= 0.5 else spent
        return f"{self.title}: {self.stage or 'starting'}; {left}"

    @property
    def state(self) -> tuple:
        """What somebody who looks at it would see, to the second."""
        spent = 0 if self.ended else int(self.spent_s)
        ending = (self.ended, self.failed, self.cancelled, self.dismissed)
        return (id(self), self.stage, self.share, len(self.training), spent, *ending)


class Slot:
    """Room for one job; every method is called from one thread and none of them waits."""

    def __init__(self, make: Callable[..., Worker] = Worker) -> None:
        self.job: Job | None = None  # the one that runs, or the last one
        self._make = make
        self._worker: Worker | None = None
        self._ending: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """Whether a job runs."""
        return self._worker is not None

    def start(self, task: Task) -> Job:
        """Start a job.

        Raises:
          DashboardError: another one runs.
        """
        if self._worker is not None and self.job is not None:
            raise DashboardError(f"{self.job.title} is still going on; wait for its end, or cancel it")
        self.job = Job(task, time.monotonic())
        self._worker = self._make(task, MODULE)
        return self.job

    def cancel(self) -> None:
        """End the job that runs; what it had not finished is gone."""
        if self._worker is not None and self.job is not None:
            self.job.cancelled = self.job.ended = True
            self._let_go()

    def dismiss(self) -> None:
        """How the last job ended has been read: no browser shows it any more."""
        if self.job is not None and self.job.ended:
            self.job.dismissed = True

    def close(self) -> None:
        """End the job that runs, and wait until its process is gone: nothing goes on without the page."""
        self.cancel()
        if self._ending is not None:
            self._ending.join()

    def poll(self) -> None:
        """Take in what the job has said."""
        if self._worker is None or self.job is None:
            return
        for event in self._worker.events():
            _take(self.job, event)
        if self.job.ended:
            self._let_go()

    def _let_go(self) -> None:
        """In a thread of its own: a simulation in progress may take seconds to end, and the page must not wait."""
        worker, self._worker = self._worker, None
        assert worker is not None
        self._ending = threading.Thread(target=worker.stop, name="stop-worker")
        self._ending.start()


def _take(job: Job, event: dict[str, Any]) -> None:
    kind = event.pop("event")
    if kind == "progress":
        job.stage, job.share, job.remaining_s = event["stage"], event["share"], event["remaining_s"]
    elif kind == "training":
        job.training.append(event["content"])
    elif kind == "result":
        job.result = event
    elif kind == "failed":
        job.failed, job.ended = event["message"], True
    elif kind == "done":
        job.ended = True
