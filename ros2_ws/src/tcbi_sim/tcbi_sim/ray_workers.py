"""Chunks worked on by a Ray cluster; Ray is an optional extra.

with cluster("") as them:                     # a cluster of this machine's processors, gone afterwards
    parts = them.map(work, chunks)

A task has one processor and one thread. When its worker is lost, the task is worked on again elsewhere. Every machine
must have the same code and the same files of the user's own (a shared folder): each task compares them with the
driver's, and says what differs instead of giving other numbers. What TCBI_… variables say here holds for the tasks.
"""

import contextlib
import copy
import functools
import hashlib
import importlib
import importlib.util
import itertools
import os
import platform
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from tcbi_contract.errors import TcbiError
from tcbi_sim.errors import SimError
from tcbi_sim.places import default_root
from tcbi_sim.workers import Here, WorkersError, using

RETRIES = 5  # of one chunk
QUEUED = 2  # chunks given out for each processor: one at work, one waiting for it
STORE_BYTES = 256 * 2**20  # of shared memory, of one's own cluster
STARTS = 3  # tried, of one's own cluster
ANSWER_S = 5.0  # that a cluster's head has to answer
SOURCES = (".py", ".toml", ".xml")  # of a package, that the bits of a simulation hang on
PACKAGES = ("tcbi_contract", "tcbi_sim", "tcbi_policy", "tcbi_infer")
OWN_KINDS = ("effects", "rigs", "tasks", "statistics", "divergences")  # of a user's own files, a folder each
OWN_FILES = f"the user's own {', '.join(OWN_KINDS[:-1])} and {OWN_KINDS[-1]}"
TOKENS = {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}  # by which a user says what Ray shall do
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


@dataclass(frozen=True)
class Home:
    """What a worker must share with the driver: settings are taken over, the rest is compared."""

    settings: Mapping[str, str]  # TCBI_… variables
    versions: Mapping[str, str]


@dataclass(frozen=True)
class Failure:
    """What a task gives where the work itself says that it cannot be done."""

    text: str


class RayWorkers:
    """The processors of a cluster."""

    threads = 0

    def __init__(self, ray: ModuleType):
        self._ray = ray
        self.processors = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._task = ray.remote(num_cpus=1, max_retries=RETRIES)(_task)
        self._home = Home(_settings(), versions())

    def map(
        self, work: Callable[[Any], Any], chunks: Sequence[Any], progress: Callable[[float], None] | None = None
    ) -> list[Any]:
        """`work` on each chunk.

        Raises:
          SimError: as `work` does, with the same words.
          WorkersError: a chunk was lost again and again, or the cluster is gone.
        """
        ray, parts = self._ray, [None] * len(chunks)
        shared, waiting = ray.put((self._home, work)), iter(enumerate(chunks))
        running: dict[Any, int] = {}
        try:
            for done in range(1, len(chunks) + 1):
                for k, chunk in itertools.islice(waiting, QUEUED * self.processors - len(running)):
                    running[self._task.remote(shared, chunk)] = k
                (task, *_), _ = ray.wait(list(running))
                parts[running.pop(task)] = self._taken(task)
                if progress:
                    progress(done / len(chunks))
        finally:
            for task in running:
                ray.cancel(task, force=True)
        return parts

    def _taken(self, task: Any) -> Any:
        errors = self._ray.exceptions
        try:
            part = self._ray.get(task)
        except errors.RayTaskError as e:
            if "No module named 'tcbi_" not in str(e):
                raise  # a fault in the code, with its traceback
            raise WorkersError(
                "a worker machine does not find tcbi; start Ray there by `./tcbi python .venv/bin/ray start …` "
                "(docs/scale.md)"
            ) from e
        except errors.RayError as e:
            text = " ".join(str(e).split())
            raise WorkersError(
                f"a chunk was lost {RETRIES + 1} times or its cluster is gone: {text[:300]}; look at the "
                "machines' memory, then start again"
            ) from e
        if isinstance(part, Failure):
            raise SimError(part.text)
        return copy.deepcopy(part)  # out of the shared memory, which is small


def _task(shared: tuple[Home, Callable[[Any], Any]], chunk: Any) -> Any:
    """One chunk, on a worker."""
    home, work = shared
    os.environ.update(home.settings)
    apart = _apart(tuple(home.versions.items()))
    if apart:
        return Failure(apart)
    try:
        with using(Here(threads=1)):
            return work(chunk)
    except TcbiError as e:
        return Failure(str(e))


def _settings() -> dict[str, str]:
    """The TCBI_... variables, with the store's, as a process in another folder understands them."""
    given = {name: value for name, value in os.environ.items() if name.startswith("TCBI_")}
    folders = {name: Path(value).expanduser() for name, value in given.items()}
    absolute = {name: str(folder.absolute()) for name, folder in folders.items() if folder.is_dir()}
    return {**given, **absolute, "TCBI_STORE": str(default_root().expanduser().absolute())}


def versions() -> dict[str, str]:
    """What must be the same on all machines for the bits to be the same, by what it is called."""
    return {
        "Python": platform.python_version(),
        "MuJoCo": mujoco.__version__,
        "numpy": np.__version__,
        "tcbi": code(PACKAGES),
        OWN_FILES: own_files(),
    }


def code(packages: Sequence[str]) -> str:
    """A digest of the files of some packages: Python, and what describes rigs."""
    specs = [importlib.util.find_spec(name) for name in packages]
    return _digest([Path(spec.origin).parent for spec in specs if spec and spec.origin], SOURCES)


def own_files(kinds: Sequence[str] = OWN_KINDS) -> str:
    """A digest of the user's own files of some kinds, all of them: one may read another."""
    return _digest([_own_folder(kind) for kind in kinds])


def _own_folder(kind: str) -> Path:
    given = os.environ.get(f"TCBI_{kind.upper()}")
    return Path(given).expanduser() if given else default_root().expanduser() / kind


def _digest(folders: Sequence[Path], suffixes: tuple[str, ...] = ("",)) -> str:
    """Of names and contents of the files below some folders whose names end so."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(p for p in folder.rglob("*") if p.name.endswith(suffixes) and p.is_file()):
            name = path.relative_to(folder)
            if any(part.startswith(".") or part == "__pycache__" for part in name.parts):
                continue
            digest.update(f"{name}".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@functools.cache
def _apart(expected: tuple[tuple[str, str], ...]) -> str:
    """What of this machine is not as on the driver's, in a sentence, or ""."""
    own = versions()
    parts = [f"{name} ({own[name]} there, {value} here)" for name, value in expected if own[name] != value]
    if not parts:
        return ""
    return (
        f"the worker machine {socket.gethostname()} differs in {', '.join(parts)}; install the same checkout on every "
        f"machine and share the store {default_root()} between them (docs/scale.md)"
    )


@contextlib.contextmanager
def cluster(address: str) -> Iterator[RayWorkers]:
    """A cluster for a while: its workers end with the block, and so does one of one's own.

    Args:
      address: HOST:PORT of its head, "auto", or "" for one of this machine's processors.

    Raises:
      WorkersError: Ray is not installed, or there is no cluster at the address.
    """
    if not address:
        _give_token()
    ray = _ray()
    _check_answer(address)
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        _start(ray, address)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, terminate)  # Ray puts its own in place
        yield RayWorkers(ray)
    finally:
        ray.shutdown()


def _start(ray: ModuleType, address: str) -> None:
    """Connect, or start a cluster of one's own, for which Ray leaves a busy machine too little time now and then."""
    for left in reversed(range(STARTS)):
        try:
            ray.init(**_options(address), log_to_driver=False, logging_level="error")
            return
        except Exception as e:  # Ray raises bare ones
            ray.shutdown()
            if address or not left:
                where = f"at {address}" if address else "could be started on this machine; is it very busy?"
                hint = "; one that has a token needs RAY_AUTH_MODE=token here too" if address else ""
                raise WorkersError(f"no Ray cluster {where}: {' '.join(str(e).split())[:300]}{hint}") from e


def _give_token() -> None:
    """A token of this process's own for its cluster, read as Ray is imported; Ray's would lie in the home."""
    if "ray" not in sys.modules and not TOKENS & os.environ.keys():
        os.environ.update(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))


def _options(address: str) -> dict[str, Any]:
    if address:
        return {"address": address}
    processors = len(os.sched_getaffinity(0))
    return {
        "address": "local",
        "num_cpus": processors,
        "num_gpus": 0,
        "object_store_memory": STORE_BYTES,
        "include_dashboard": False,
    }


def _ray() -> ModuleType:
    os.environ.update({name: os.environ.get(name, value) for name, value in QUIET.items()})
    try:
        return importlib.import_module("ray")
    except ImportError as e:
        raise WorkersError(
            "workers ray needs ray, which is an optional extra; install it with "
            "`.tcbi/boot/bin/uv pip install --python .venv -r requirements-ray.in`"
        ) from e


def _check_answer(address: str) -> None:
    """Whether anybody listens there; Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host:
        return
    try:
        socket.create_connection((host, int(port)), ANSWER_S).close()
    except (OSError, OverflowError) as e:
        raise WorkersError(
            f"nobody answers at {address} ({e}); start the head there with `ray start --head`, or give the "
            "address that it prints"
        ) from e
