"""A training run as a folder and a subprocess: what a node or a command starts, follows, cancels and resumes.

    run = Run.of(config, model, root, start="balance", rival="balance")
    folder = write_run(store.folder("runs") / run.key("train"), run)
    with TrainingProcess(folder) as process:
        for event in process.events():        # dicts, see training_process.py
            ...

This module imports neither torch nor rclpy. A process that died is started again on the same folder and goes on.
"""

import contextlib
import dataclasses
import fcntl
import hashlib
import importlib.metadata
import json
import os
import platform
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tcbi_contract.files import remove_unfinished, replace_file
from tcbi_policy.artefact import find_policy
from tcbi_policy.configuration import TrainingConfig
from tcbi_policy.errors import TrainingError
from tcbi_sim.model import Model
from tcbi_sim.ray_workers import code, own_files

ORPHAN_S = 10.0
NICENESS = 10  # a robot moves in real time beside it
GRACE_S = 0.5  # between asking a process to end and ending it
SPEC = "run.json"
OWN_KINDS = ("effects", "rigs", "tasks")  # of the user's files, that a training may depend on
PACKAGES = ("tcbi_contract", "tcbi_sim", "tcbi_policy")  # whose code it depends on
LIBRARIES = ("torch", "stable-baselines3", "mujoco", "numpy")
ERRORS = "errors.log"
FAILED = "failed"  # the event with which a process says, in `message`, why it cannot go on


@dataclass(frozen=True)
class Run:
    """All that decides the result of a training run."""

    config: TrainingConfig
    model: str  # version, never "latest"
    store: str = ""  # root of the model store; empty for the default
    start: str = ""  # policy to start from; empty for scratch
    rival: str = ""  # policy that the result is compared with; empty for none
    pairs: int = 64  # held-out rollouts of that comparison
    contents: str = ""  # ids of those policies, digests of particles, own files and code, versions: see `of`

    def key(self, purpose: str) -> str:
        """A folder name that is the same for the same run."""
        digest = hashlib.sha256(self.to_json().encode()).hexdigest()[:12]
        return f"{purpose}-{self.config.task}-{digest}"

    def to_json(self) -> str:
        """As it lies in the folder."""
        return json.dumps({**dataclasses.asdict(self), "config": json.loads(self.config.to_json())}, indent=1) + "\n"

    @staticmethod
    def of(config: TrainingConfig, model: Model, root: Path, start: str = "", rival: str = "") -> "Run":
        """A run with what its names stand for at present, and the code and libraries that this process has loaded.

        A training goes on only on those that it began with: its checkpoint may mean something else to others.

        Raises:
          PolicyError: start or rival cannot be loaded.
        """
        ids = [find_policy(reference, root).policy_id for reference in (start, rival) if reference]
        ids += [f"particles {_digest(model)}", f"own files {own_files(OWN_KINDS)}", LOADED]
        return Run(config, model.version, str(root), start, rival, contents=", ".join(ids))

    @staticmethod
    def from_folder(folder: Path) -> "Run":
        """Read a run's folder.

        Raises:
          TrainingError: it is not one.
        """
        try:
            data = json.loads((folder / SPEC).read_text())
            config = TrainingConfig.from_json(json.dumps(data.pop("config")))
            return Run(config.checked(), **data)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
            raise TrainingError(f"{folder} is not the folder of a training run: {e}") from e


def _digest(model: Model) -> str:
    return hashlib.sha256(model.contents).hexdigest()[:12]


def library_versions() -> dict[str, str]:
    """Versions of Python and of the libraries that a training depends on."""
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in LIBRARIES}}


def installed() -> str:
    """The code and the libraries that lie on the disk at present, in the words with which a run's `contents` end."""
    return ", ".join(f"{name} {value}" for name, value in {"code": code(PACKAGES), **library_versions()}.items())


LOADED = installed()  # what this process runs on, whatever comes to lie on the disk after its start


def write_run(folder: Path, run: Run) -> Path:
    """Make a run's folder, or go on with the one that holds the same run.

    Raises:
      TrainingError: the folder holds another run.
    """
    run.config.checked()
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / SPEC).exists():
        if Run.from_folder(folder) != run:
            raise TrainingError(f"{folder} holds another training run; remove it, or choose another name")
    else:
        replace_file(folder / SPEC, run.to_json().encode())
    return folder


@contextlib.contextmanager
def alone(folder: Path, patience_s: float = ORPHAN_S) -> Iterator[None]:
    """Keep every other process from training in a run's folder, and remove what a killed one left half written there.

    One whose parent was killed ends by itself; so long it is waited for.

    Raises:
      TrainingError: another one trains there and goes on, or has ended the run meanwhile.
    """
    deadline = time.monotonic() + patience_s
    with (folder / SPEC).open() as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise TrainingError(
                        f"{folder}: another process trains this run; wait for its end, or choose another name or seed"
                    ) from None
                time.sleep(0.1)
        if not (folder / SPEC).exists():
            raise TrainingError(ended_meanwhile(folder))
        remove_unfinished(folder)
        yield


def ended_meanwhile(folder: Path) -> str:
    """What to tell where a run's folder is gone: who asked for the same run has got its result."""
    return (
        f"{folder}: the same training has ended meanwhile, in another process; ./tcbi policy lists what came of it, "
        "and the same command trains anew"
    )


class TrainingProcess:
    """`python -P -m tcbi_policy.training_process`, in a process group of its own and at low priority.

    Without a folder it loads its libraries, which takes seconds, and stands by until `begin`.
    """

    def __init__(self, folder: Path | None = None):
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "tcbi_policy.training_process"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=dict(os.environ, PYTHONUNBUFFERED="1"), start_new_session=True,
        )  # fmt: skip
        os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        self._folder, self._said_before = Path(), 0  # bytes of its log from earlier lives
        self._fault = ""  # why it cannot go on, in its own words
        self._events: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if folder is not None:
            self.begin(folder)

    def begin(self, folder: Path) -> None:
        """Train in a run's folder, once."""
        assert self._process.stdin is not None
        self._folder = folder
        log = folder / ERRORS
        self._said_before = log.stat().st_size if log.exists() else 0
        with contextlib.suppress(BrokenPipeError):  # it has died; `check` tells
            self._process.stdin.write(f"{folder.absolute()}\n")
            self._process.stdin.flush()  # and stays open: its end tells the process that this one has ended

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                event = json.loads(line)
            except ValueError:  # a library wrote to standard output
                sys.stderr.write(line)
                continue
            if isinstance(event, dict) and event.get("event") == FAILED:
                self._fault = event["message"]
            else:
                self._events.put(event)
        self._events.put(None)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def poll(self, timeout_s: float) -> tuple[dict[str, Any] | None, bool]:
        """The next event if one comes within the time, and whether the process has closed its output."""
        try:
            event = self._events.get(timeout=timeout_s)
        except queue.Empty:
            return None, False
        return event, event is None

    def events(self) -> Iterator[dict[str, Any]]:
        """All events until the process ends.

        Raises:
          TrainingError: it failed.
        """
        while True:
            event, closed = self.poll(3600.0)
            if closed:
                break
            if event is not None:
                yield event
        self.check()

    def check(self) -> None:
        """Wait for the end of a process that has closed its output.

        Raises:
          TrainingError: it failed, with its own words, or the last line of its log where it had none.
        """
        status = self._process.wait()
        if status != 0:
            again = " (was memory short? the same call goes on from the last checkpoint)"
            how = f"signal {-status}{again}" if status < 0 else f"status {status}"
            raise TrainingError(f"training ended with {how}: {self._fault or self._last_line()}")

    def _last_line(self) -> str:
        """Of what it has logged in this life, and where the rest is."""
        log = self._folder / ERRORS
        said = log.read_bytes()[self._said_before :] if log.exists() else b""
        lines = said.decode(errors="replace").strip().splitlines()
        return f"{lines[-1] if lines else 'no message'} (see {log})"

    def end(self) -> None:
        """End the process within a second; what it has learnt up to its last checkpoint stays."""
        if self._process.poll() is not None:
            return
        self._process.terminate()
        try:
            self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """End it and let go of its pipes."""
        self.end()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
