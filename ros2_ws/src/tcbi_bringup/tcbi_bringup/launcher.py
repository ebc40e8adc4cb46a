"""Starts, watches, restarts and stops the processes of a graph.

    sim = NodeProcess("tcbi_sim", "sim_node", parameters={"lockstep": True})
    processes = [sim, NodeProcess("tcbi_policy", "policy_node")]
    with Graph(processes, domain_id=7, log_dir=folder) as graph:
        ...                                   # the processes run; wait for their topics, never for a fixed time
        graph.check()                         # raises LaunchError with the last lines of its log if one has failed
        codes = graph.stop()                  # {"sim_node": 0, "policy_node": 0}

- Every process has a session of its own, so that Ctrl-C reaches the launcher alone, which passes it on in order.
- If the launcher dies, however it dies, the kernel ends its processes.
- Stopping means SIGINT, then SIGTERM, then SIGKILL to all that the process has started.
- With `restart=True` a process that ends with a fault starts again after a pause that doubles; one that fails
  at once, again and again, is given up, with the reason in its status.

No rclpy in here: one thread owns all the processes, and nothing blocks the caller.
"""

import contextlib
import json
import os
import shlex
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tcbi_bringup.child import tied_to
from tcbi_bringup.errors import LaunchError
from tcbi_bringup.executables import find_executable

POLL_S = 0.05
LOG_MARK = "--- started "  # begins the line that each start writes to the log
INTERRUPT_S, TERMINATE_S = 8.0, 3.0  # time given after SIGINT, after SIGTERM
REAP_S = 2.0  # for a killed process to be seen dead
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
HEALTHY_AFTER_S = 60.0  # a process that ran this long starts its count of failures anew; loaded machines start slowly
TRIES = 5  # failures in a row before a process is given up
CONFIGURATION_TRIES = 2  # the same for exit status 1: bad configuration or an absent device; no crash ends with it


@dataclass(frozen=True)
class NodeProcess:
    """What to start: one executable of one package.

    Attributes:
      package: e.g. "tcbi_sim".
      executable: e.g. "sim_node".
      name: the key in the graph, and the node's name if `rename`; the executable's name if empty.
      namespace: "" or e.g. "/left".
      parameters: ROS parameters; lists, numbers, strings, booleans.
      remappings: from name to name.
      arguments: put before `--ros-args`.
      environment: variables set for this process.
      ros: False for a program that takes no `--ros-args`.
      rename: give the node `name` instead of its own name.
      essential: the graph is pointless without it.
      after_crash: parameters of a start that follows a crash, beside the others.
    """

    package: str
    executable: str
    name: str = ""
    namespace: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    remappings: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    ros: bool = True
    rename: bool = False
    essential: bool = False
    after_crash: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Its name in the graph."""
        return self.name or self.executable

    def command(self, after_crash: bool = False) -> list[str]:
        """The command line, with its path."""
        words = [str(find_executable(self.package, self.executable)), *self.arguments]
        return words + self.ros_arguments(after_crash) if self.ros else words

    def ros_arguments(self, after_crash: bool = False) -> list[str]:
        """The part from `--ros-args` on."""
        words = ["--ros-args"]
        if self.rename:
            words += ["-r", f"__node:={self.key}"]
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        for source, target in self.remappings.items():
            words += ["-r", f"{source}:={target}"]
        for name, value in {**self.parameters, **(self.after_crash if after_crash else {})}.items():
            plain = str(value) if isinstance(value, Path) else value
            words += ["-p", f"{name}:={json.dumps(plain, ensure_ascii=False)}"]
        return words if len(words) > 1 else []


@dataclass(frozen=True)
class ProcessStatus:
    """How one process fares.

    Attributes:
      state: "running", "waiting" (for its restart), "ended", "given up".
      exit_code: of the last end; negative for a signal.
      started: wall time in s of the last start.
      reason: why it was given up.
    """

    name: str
    state: str
    pid: int | None = None
    restarts: int = 0
    exit_code: int | None = None
    started: float = 0.0
    reason: str = ""
    essential: bool = False


class _Supervised:
    """One process and its history; touched by the supervising thread alone."""

    def __init__(self, what: NodeProcess, log: Path) -> None:
        self.what, self.log = what, log
        self.commands = what.command(), what.command(after_crash=True)  # of the first start, of all others
        self.process: subprocess.Popen | None = None
        self.failures = self.refusals = 0  # in a row: of all, and with exit status 1
        self.retry_at = 0.0
        self.status = ProcessStatus(what.key, "waiting", essential=what.essential)

    def start(self, environment: Mapping[str, str]) -> None:
        command = self.commands[bool(self.status.started)]
        with self.log.open("a", encoding="utf-8") as log:
            line = shlex.join(command).replace("\n", " ")
            log.write(f"{LOG_MARK}{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n")
            log.flush()
            self.process = subprocess.Popen(
                tied_to(os.getpid(), command),
                env={**environment, **self.what.environment},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.status = replace(self.status, state="running", pid=self.process.pid, started=time.time())

    def poll(self, restart: bool) -> None:
        """Notice an end, and decide what follows."""
        if self.process is None or (code := self.process.poll()) is None:
            return
        self.process = None
        if time.time() - self.status.started >= HEALTHY_AFTER_S:
            self.failures = self.refusals = 0
        self.status = replace(self.status, state="ended", pid=None, exit_code=code)
        if code == 0 or not restart:
            return
        self.failures += 1
        self.refusals = self.refusals + 1 if code == 1 else 0
        if self.failures >= TRIES or self.refusals >= CONFIGURATION_TRIES:
            reason = f"{self.what.key} failed {self.failures} times in a row, last with {describe_exit(code)}"
            reason += "".join(f": {line}" for line in self.last_lines(1))
            self.status = replace(self.status, state="given up", reason=reason)
            return
        self.retry_at = time.monotonic() + min(FIRST_PAUSE_S * 2 ** (self.failures - 1), LONGEST_PAUSE_S)
        self.status = replace(self.status, state="waiting")

    def last_lines(self, count: int) -> list[str]:
        """The last lines that its latest start has written."""
        text = self.log.read_text(encoding="utf-8", errors="replace") if self.log.exists() else ""
        return text.rpartition(LOG_MARK)[2].strip().splitlines()[1:][-count:]

    def retry(self, environment: Mapping[str, str]) -> None:
        if self.status.state == "waiting" and self.process is None and time.monotonic() >= self.retry_at:
            first = not self.status.started
            try:
                self.start(environment)
            except OSError as e:
                self.status = replace(self.status, state="given up", reason=f"{self.what.key} cannot be started: {e}")
                return
            self.status = replace(self.status, restarts=self.status.restarts + (not first))


class Graph:
    """A set of processes in one ROS domain. A context manager: leaving it stops all of them."""

    def __init__(
        self,
        processes: Iterable[NodeProcess] = (),
        *,
        domain_id: int | None = None,
        log_dir: str | Path | None = None,
        restart: bool = False,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Set up without starting anything.

        Args:
          processes: what to start on entering; `start` adds more.
          domain_id: ROS domain; None keeps that of the caller.
          log_dir: one log file per process goes here; None makes a temporary folder.
          restart: start again what fails.
          environment: variables set for every process.

        Raises:
          UnknownExecutableError: before anything is started.
        """
        self.log_dir = Path(log_dir) if log_dir else Path(tempfile.mkdtemp(prefix="tcbi-graph-"))
        self.log_dir.mkdir(parents=True, exist_ok=True)
        self._environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})}
        self._environment.setdefault("ROS_LOG_DIR", str(self.log_dir / "ros"))
        if domain_id is not None:
            self._environment["ROS_DOMAIN_ID"] = str(domain_id)
        self._restart = restart
        self._lock = threading.RLock()
        self._all: dict[str, _Supervised] = {}
        self._stopping: set[str] = set()
        self._done = threading.Event()
        self._thread: threading.Thread | None = None
        for process in processes:
            self._add(process)

    def __enter__(self) -> "Graph":
        self._thread = threading.Thread(target=self._supervise, name="graph", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        impatient = kind is KeyboardInterrupt and bool(self._stopping)  # Ctrl-C again, while all are being stopped
        try:
            if not impatient:
                self.stop()
        finally:  # also of Ctrl-C just here
            for name in self._all:
                self._signal(name, signal.SIGKILL, group=True)
            self._wait(self._all, REAP_S)
            self._done.set()
            if self._thread:
                self._thread.join()

    def start(self, process: NodeProcess) -> None:
        """Add one process to the running graph; it starts at once."""
        self._add(process)

    def stop(self, *names: str) -> dict[str, int]:
        """Stop the named processes, or all; returns the exit code of each (of its last end)."""
        with self._lock:
            chosen = list(names or self._all)
            self._require(chosen)
            self._stopping.update(chosen)
        for kind, patience in ((signal.SIGINT, INTERRUPT_S), (signal.SIGTERM, TERMINATE_S), (signal.SIGKILL, None)):
            alive = [name for name in chosen if self._alive(name)]
            for name in alive:
                self._signal(name, kind, group=kind != signal.SIGINT)
            self._wait(alive, patience)
        with self._lock:
            for name in chosen:
                s = self._all[name]
                if s.status.state == "waiting":
                    s.status = replace(s.status, state="ended")
            return {name: code for name in chosen if (code := self._all[name].status.exit_code) is not None}

    def send_signal(self, name: str, kind: int) -> None:
        """Send a signal to one process, e.g. SIGKILL to see what follows."""
        with self._lock:
            self._require([name])
        self._signal(name, kind, group=False)

    def status(self) -> list[ProcessStatus]:
        """How each process fares, in the order of their start."""
        with self._lock:
            return [s.status for s in self._all.values()]

    def wait_for_exit(self, name: str, timeout_s: float) -> int:
        """Wait until a process ends for good; returns its exit code.

        Raises:
          LaunchError: it still ran at the deadline.
        """
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            status = {s.name: s for s in self.status()}[name]
            if status.state in ("ended", "given up") and status.exit_code is not None:
                return status.exit_code
            time.sleep(POLL_S)
        raise LaunchError(f"{name} still ran after {timeout_s:g} s; its log is {self.log_path(name)}")

    def log_path(self, name: str) -> Path:
        """The log file of a process."""
        return self.log_dir / f"{name}.log"

    def log(self, name: str) -> str:
        """What a process has written so far."""
        path = self.log_path(name)
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    def tail(self, name: str, lines: int = 5) -> str:
        """The last lines that its latest start has written."""
        return "\n".join(self._all[name].last_lines(lines))

    def check(self) -> None:
        """Raise LaunchError if a process has failed, with the last lines of its log."""
        if failed := self._failed():
            raise LaunchError(f"{self.explain(failed)}; its last lines:\n{self.tail(failed.name, 20)}")

    def check_briefly(self) -> None:
        """The same in one line, with the last of its log, for the terminal."""
        if failed := self._failed():
            last = "" if failed.reason else "".join(f": {line}" for line in self._all[failed.name].last_lines(1))
            raise LaunchError(f"{self.explain(failed)}{last}")

    def _failed(self) -> ProcessStatus | None:
        for status in self.status():
            failed = status.state == "given up" or (status.state == "ended" and status.exit_code)
            if failed and status.name not in self._stopping:
                return status
        return None

    def explain(self, status: ProcessStatus) -> str:
        """Why a process ended, and where its log is."""
        why = status.reason or f"{status.name} ended with {describe_exit(status.exit_code)}"
        return f"{why}; its log is {self.log_path(status.name)}"

    def _add(self, process: NodeProcess) -> None:
        with self._lock:
            if process.key in self._all:
                raise LaunchError(f"two processes are named {process.key!r}; give one another name")
            self._all[process.key] = _Supervised(process, self.log_path(process.key))

    def _require(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._all:
                raise LaunchError(f"no process {name!r} in this graph; there are {', '.join(self._all) or 'none'}")

    def _supervise(self) -> None:
        while not self._done.is_set():
            with self._lock:
                for name, supervised in self._all.items():
                    supervised.poll(self._restart and name not in self._stopping)
                    if name not in self._stopping:
                        supervised.retry(self._environment)
            self._done.wait(POLL_S)

    def _alive(self, name: str) -> bool:
        with self._lock:
            return self._all[name].process is not None

    def _signal(self, name: str, kind: int, *, group: bool) -> None:
        with self._lock, contextlib.suppress(ProcessLookupError):
            process = self._all[name].process
            if process is not None:
                os.killpg(process.pid, kind) if group else os.kill(process.pid, kind)

    def _wait(self, names: Iterable[str], patience: float | None) -> None:
        deadline = time.monotonic() + (patience if patience is not None else 60.0)
        while any(self._alive(name) for name in names) and time.monotonic() < deadline:
            time.sleep(POLL_S)


def describe_exit(code: int | None) -> str:
    """An exit code in words."""
    if code is None:
        return "no exit status"
    if code >= 0:
        return f"exit status {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"
