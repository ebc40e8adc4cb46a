"""Both ends of a worker process: `Worker` starts one and never waits for it, `serve` is what one does.

A job is one JSON object on standard input; events are JSON objects on standard output, one a line, each with `event`:
what the job tells, and at last `done` or `failed`.
"""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from tcbi_contract.errors import TcbiError
from tcbi_contract.plain import plain

STOP_TIMEOUT_S = 5.0
NICENESS = 10  # of a worker: a robot may move in real time beside it
INFERENCE = "tcbi_infer.inference_worker"
Emit = Callable[..., None]  # an event's name, and what it tells


class Job(Protocol):
    """What a worker is asked for, as one line of JSON."""

    def to_json(self) -> str: ...


class Worker:
    """One run of `tcbi_infer.inference_worker`, or of another module whose `main` is `serve`."""

    def __init__(self, job: Job, module: str = INFERENCE):
        self.job = job
        self._events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
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
                event = _event(line)
                if event is None:  # a library wrote to standard output
                    sys.stderr.write(line)
                    continue
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


def _event(line: str) -> dict[str, Any] | None:
    """The event of a line; None where it holds none."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and "event" in event else None


def serve(run: Callable[[str, Emit], None]) -> int:
    """Be a worker: `run` the line on standard input; the exit status is 0 when done, 1 when failed or ended."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    out, sys.stdout = sys.stdout, sys.stderr  # whatever a library prints must not mix with the events

    def emit(event: str, **content: Any) -> None:
        out.write(json.dumps({"event": event, **plain(content)}) + "\n")
        out.flush()

    try:
        run(sys.stdin.readline(), emit)
        emit("done")
        return 0
    except (TcbiError, OSError) as e:  # OSError: a full disk, a folder that is gone
        if isinstance(e, BrokenPipeError):  # who asked for it has died
            return 1
        emit("failed", message=" ".join(str(e).split()))
        return 1
    except KeyboardInterrupt:  # ended
        return 1
