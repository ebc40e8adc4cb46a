"""Runs the programs of the set-up: output to the log file, progress to standard error."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from tcbi_setup.layout import LOG, ROOT, SetupError

QUIET_PERIOD_S = 15.0  # between two signs of life where standard error is no terminal


def say(text: str) -> None:
    """One line to the user."""
    print(f"tcbi: {text}", file=sys.stderr, flush=True)


def run(step: str, command: Sequence[str | Path], environment: Mapping[str, str], remedy: str) -> str:
    """Run one program of a step to its end, showing that it lives.

    Returns: what it wrote.
    Raises:
      SetupError: it failed; the text holds its last lines and the remedy.
    """
    LOG.parent.mkdir(parents=True, exist_ok=True)
    with LOG.open("a+", encoding="utf-8", errors="replace") as log:
        log.write(f"\n$ {' '.join(map(str, command))}\n")
        log.flush()
        start = log.seek(0, os.SEEK_END)
        process = subprocess.Popen(
            [str(word) for word in command],
            cwd=ROOT,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            close_fds=False,  # it holds the set-up's lock, too
        )
        try:
            _watch(step, process)
        except BaseException:
            _stop(process)
            raise
        log.seek(start)
        output = log.read()
    if process.returncode:
        raise SetupError(f"{step} failed (exit {process.returncode}); {remedy}; all of it is in {LOG}\n{_tail(output)}")
    return output


def _watch(step: str, process: subprocess.Popen) -> None:
    began = shown = time.monotonic()
    terminal = sys.stderr.isatty()
    while process.poll() is None:
        time.sleep(0.1)
        now = time.monotonic()
        if now - shown < (1.0 if terminal else QUIET_PERIOD_S):
            continue
        shown = now
        print(f"\r      {step} … {now - began:.0f} s", end="" if terminal else "\n", file=sys.stderr, flush=True)
    if terminal:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def _stop(process: subprocess.Popen) -> None:
    for kind in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, kind)
            process.wait(5)
            return
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def _tail(output: str, lines: int = 12) -> str:
    return "\n".join(f"    {line}" for line in output.strip().splitlines()[-lines:])
