"""Where chunks of simulations are worked on: in this process, or on all machines of a Ray cluster.

    with workers("ray"):                                 # or "ray:HOST:PORT"; "" is this process, as without any
        out = simulate(model, values, scenarios, commands=recorded)          # the same bits

    parts = present().map(work, chunks)                  # [work(chunk) for chunk in chunks], for whoever cuts work up

What a chunk gives depends on nothing but the chunk, so that it does not matter where or how often it is worked on.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol, TypeVar

from tcbi_contract.errors import describe
from tcbi_sim.errors import SimError

PATTERN = re.compile(r"ray(?::(auto|[^\s:/]+:\d+))?")
ALLOWED = "ray (this machine), ray:HOST:PORT (a cluster by its head's address) or ray:auto (the one that runs here)"
LEAST_STEPS = 10_000  # of physics in a chunk, a third of a second of a core: what a chunk costs besides is little
MOST_STEPS = 200_000  # some seconds of a core, all that a lost worker costs; bounds what travels back at once
EACH = 4  # chunks for each processor, so that the last one to finish keeps nobody waiting for long
Chunk = TypeVar("Chunk")
Part = TypeVar("Part")


class WorkersError(SimError):
    """The workers that were asked for cannot be had, or were lost."""


class Workers(Protocol):
    """Somebody who works on chunks."""

    @property
    def processors(self) -> int:
        """Chunks worked on at a time."""

    @property
    def threads(self) -> int:
        """Of each simulation, whatever it asks for; 0: as many as it asks for."""

    def map(
        self, work: Callable[[Chunk], Part], chunks: Sequence[Chunk], progress: Callable[[float], None] | None = None
    ) -> list[Part]:
        """`work` on each chunk, in their order; `progress` is told the share done."""


@dataclass(frozen=True)
class Here:
    """This process: one chunk at a time, each with all threads."""

    threads: int = 0
    processors: int = 1

    def map(
        self, work: Callable[[Chunk], Part], chunks: Sequence[Chunk], progress: Callable[[float], None] | None = None
    ) -> list[Part]:
        """`work` on each chunk, one after the other."""
        parts: list[Part] = []
        for chunk in chunks:
            parts.append(work(chunk))
            if progress:
                progress(len(parts) / len(chunks))
        return parts


_present: ContextVar[Workers] = ContextVar("workers", default=Here())  # noqa: B039 - frozen


def present() -> Workers:
    """Those that work now."""
    return _present.get()


def threads_here(asked: int = 0) -> int:
    """Threads that work in this process may take: as many as those that work now allow, else as asked, else all."""
    return present().threads or asked or len(os.sched_getaffinity(0))


@contextlib.contextmanager
def using(them: Workers) -> Iterator[None]:
    """Let some workers work for a while."""
    before = _present.set(them)
    try:
        yield
    finally:
        _present.reset(before)


@contextlib.contextmanager
def workers(where: str) -> Iterator[None]:
    """Let the workers that a command line names work for a while.

    Args:
      where: "" for this process, "ray", "ray:HOST:PORT" or "ray:auto".

    Raises:
      WorkersError: they cannot be had.
    """
    if not where:
        yield
        return
    address = address_of(where)
    from tcbi_sim.ray_workers import cluster

    with cluster(address) as them, using(them):
        yield


def address_of(where: str) -> str:
    """The cluster's address, "" for a cluster of one's own on this machine.

    Raises:
      WorkersError: these are no workers.
    """
    match = PATTERN.fullmatch(where)
    if match is None:
        raise WorkersError(describe("workers", where, ALLOWED))
    return match[1] or ""


def chunk_size(count: int, steps: float, most: int) -> int:
    """How many of `count` equal things make a chunk for those that work now.

    Args:
      count: of the things.
      steps: of physics in each.
      most: that this process would take at a time.
    """
    processors = present().processors
    if processors == 1:
        return most
    least = max(1, round(LEAST_STEPS / max(steps, 1.0)))
    most = min(most, max(1, int(MOST_STEPS / max(steps, 1.0))))
    chunks = max(min(EACH * processors, count // least), -(-count // most), 1)
    return -(-count // chunks)
