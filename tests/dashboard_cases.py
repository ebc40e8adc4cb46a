"""A page in a real browser, and rollouts of a servo bench that has an effect which the model lacks."""

import dataclasses
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

DEADLINE_S = 240.0  # far beyond what is needed, for a machine that does much else
HIDDEN, SIZE = "backlash", 0.12  # rad
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def launch(playwright):
    """A browser: the system's, else Playwright's own; skips the test where there is none."""
    from playwright.sync_api import Error

    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    flags = ["--no-sandbox", *SOFTWARE_GL] if os.geteuid() == 0 else list(SOFTWARE_GL)
    try:
        return playwright.chromium.launch(executable_path=path, args=flags)
    except Error as e:
        pytest.skip(f"no Chromium to look at the page with: {str(e).splitlines()[0]}")


class Server:
    """`./tcbi dashboard` on a store; started again on the same port by `start`."""

    def __init__(self, store: Path, *arguments: str, domain: int | None = None) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.store, self._arguments = store, arguments
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}  # NiceGUI would act on it
        self._environment = inherited | ({} if domain is None else {"ROS_DOMAIN_ID": str(domain)})
        self._process: subprocess.Popen[str] | None = None
        self.start()

    @property
    def address(self) -> str:
        """Of the page on this machine."""
        return f"http://localhost:{self.port}"

    @property
    def pid(self) -> int:
        """Of the process."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start it, and wait until it says its address."""
        command = [sys.executable, "-P", "-m", "tcbi_bringup.cli", "dashboard", "--json"]
        command += ["--store", str(self.store), "--port", str(self.port), *self._arguments]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=self._environment)
        assert self._process.stdout is not None
        lines = []
        for line in self._process.stdout:
            lines.append(line)
            if line.startswith("}"):
                break
        assert lines, f"it ended with status {self._process.wait()}"
        self.said = json.loads("".join(lines))
        self._wait()

    def _wait(self) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            try:
                urllib.request.urlopen(self.address, timeout=5.0)
                return
            except urllib.error.HTTPError:
                return
            except OSError:
                time.sleep(0.05)
        pytest.fail("the page did not come up")

    def stop(self) -> int:
        """Ctrl-C; returns the exit status."""
        assert self._process is not None and self._process.stdout is not None
        self._process.send_signal(signal.SIGINT)
        try:
            return self._process.wait(DEADLINE_S)
        finally:
            self._process.stdout.close()

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process is not None and self._process.stdout is not None
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def bench_rollouts(motions: int = 6, seconds: float = 3.0, first: int = 0) -> Iterator[Measurement]:
    """Motions of a servo bench with backlash, each recorded twice with the encoder's noise."""
    model = base_model("servo_bench").with_effect(HIDDEN)
    values = model.mean()
    values[-1] = SIZE
    rng = np.random.default_rng(first)
    for k in range(first, first + motions):
        time_s = np.arange(0.0, seconds, 0.1)
        target = (
            0.7
            * np.sin(2 * np.pi * (0.4 + 0.15 * k) * time_s + k)[:, None]
            * np.sign(np.sin(3.0 * time_s + k))[:, None]
        )
        commands = Commands(time_s, target, ramp=0.1)
        scenario = Scenario("swing", seconds)
        clean = simulate(model, values[None], [scenario], commands=[commands]).measurement(0, 0)
        for again in "ab":
            noise = rng.normal(0, 1.5e-3, clean.joint_position.shape)
            yield dataclasses.replace(
                clean,
                rollout_id=f"swing{k}{again}",
                policy_id=f"motion:{k}",
                source="bench",
                commands=commands,
                joint_position=clean.joint_position + noise,
            )


def record(store: Path, rollouts: Iterator[Measurement]) -> None:
    """Put rollouts into a store."""
    for n, rollout in enumerate(rollouts):
        write_measurement(store / "rollouts", rollout, start_ns=(1_700_000_000 + n) * 1_000_000_000)
