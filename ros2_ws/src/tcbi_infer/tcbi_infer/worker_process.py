"""A worker process watched without blocking: start it with a job, ask now and then what it said."""

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any, Protocol

STOP_TIMEOUT_S = 5.0
INFERENCE = "tcbi_infer.inference_worker"


class Job(Protocol):
    """What a worker is asked for, as one line of JSON."""

    def to_json(self) -> str: ...


class Worker:
    """One run of `tcbi_infer.inference_worker`, or of another module that reads a job and writes events like it."""

    def __init__(self, job: Job, module: str = INFERENCE):
        self.job = job
        self._events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdin is not None
        self._process.stdin.write(job.to_json() + "\n")
        self._process.stdin.close()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        ended = False
        with self._process.stdout as lines:
            for line in lines:
                event = json.loads(line)
                ended = event["event"] in ("done", "failed")
                self._events.put(event)
        status = self._process.wait()
        if not ended:
            self._events.put({"event": "failed", "message": f"the worker process ended with status {status}"})

    def events(self) -> Iterator[dict[str, Any]]:
        """What it said since the last call; does not wait."""
        while True:
            try:
                yield self._events.get_nowait()
            except queue.Empty:
                return

    def stop(self) -> None:
        """End it; an inference keeps the state of its last whole generation."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(STOP_TIMEOUT_S)
