"""The launcher with plain programs in the place of nodes: no ROS in these tests."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from tcbi_bringup import launcher
from tcbi_bringup.errors import LaunchError
from tcbi_bringup.launcher import Graph, NodeProcess

DEADLINE_S = 30.0
PATIENT = """
import signal, time
signal.signal(signal.SIGINT, lambda *_: exit(0))
print('up', flush=True)
time.sleep(600)
"""
STUBBORN = PATIENT.replace("lambda *_: exit(0)", "signal.SIG_IGN")
DEAF = STUBBORN.replace("print(", "signal.signal(signal.SIGTERM, signal.SIG_IGN); print(")


@dataclass(frozen=True)
class Program(NodeProcess):
    """A Python program given as text."""

    def command(self, after_crash: bool = False) -> list[str]:
        return [sys.executable, "-c", self.executable, *(["after a crash"] if after_crash else [])]


def program(name: str, code: str, **more) -> Program:
    return Program("", code, name=name, ros=False, **more)


def wait_for(condition, what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen in {DEADLINE_S} s"
        time.sleep(0.02)


def is_up(graph: Graph, name: str) -> bool:
    return "up" in graph.tail(name)


@contextlib.contextmanager
def interruptible():
    """Ctrl-C interrupts, also where the tests run in the background of a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def status(graph: Graph, name: str):
    return {s.name: s for s in graph.status()}[name]


def test_stop_ends_cleanly_what_obeys_an_interrupt(tmp_path):
    with Graph([program("one", PATIENT), program("two", PATIENT)], log_dir=tmp_path) as graph:
        wait_for(lambda: is_up(graph, "one") and is_up(graph, "two"), "start")
        assert graph.stop() == {"one": 0, "two": 0}


@pytest.mark.parametrize(("code", "ending"), [(STUBBORN, -signal.SIGTERM), (DEAF, -signal.SIGKILL)])
def test_stop_ends_by_force_what_ignores_it(tmp_path, monkeypatch, code, ending):
    monkeypatch.setattr(launcher, "INTERRUPT_S", 0.3)
    monkeypatch.setattr(launcher, "TERMINATE_S", 0.3)
    with Graph([program("one", code)], log_dir=tmp_path) as graph:
        wait_for(lambda: is_up(graph, "one"), "start")
        assert graph.stop() == {"one": ending}


def test_who_interrupts_a_stop_waits_no_longer(tmp_path):
    with pytest.raises(KeyboardInterrupt), Graph([program("deaf", DEAF)], log_dir=tmp_path) as graph:
        wait_for(lambda: is_up(graph, "deaf"), "start")
        main = threading.get_ident()
        threading.Timer(0.5, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
        began = time.monotonic()
        with interruptible():
            graph.stop()
    assert time.monotonic() - began < launcher.INTERRUPT_S
    assert status(graph, "deaf").exit_code == -signal.SIGKILL


def test_a_crashed_process_starts_again(tmp_path):
    with Graph([program("one", PATIENT)], log_dir=tmp_path, restart=True) as graph:
        wait_for(lambda: is_up(graph, "one"), "start")
        first = status(graph, "one").pid
        graph.send_signal("one", signal.SIGKILL)
        wait_for(lambda: status(graph, "one").pid not in (None, first), "restart")
        assert status(graph, "one").restarts == 1
        starts = [line for line in graph.log("one").splitlines() if line.startswith(launcher.LOG_MARK)]
        assert [line.endswith("'after a crash'") for line in starts] == [False, True]


def test_without_restart_a_failure_is_reported_with_its_last_words(tmp_path):
    with Graph([program("one", "print('no such port'); exit(1)")], log_dir=tmp_path) as graph:
        assert graph.wait_for_exit("one", DEADLINE_S) == 1
        with pytest.raises(LaunchError, match=r"(?s)exit status 1.*no such port"):
            graph.check()
        with pytest.raises(LaunchError, match=r"exit status 1; its log is .*: no such port") as told:
            graph.check_briefly()
        assert "\n" not in str(told.value)


@pytest.mark.parametrize(("code", "tries"), [("exit(1)", launcher.CONFIGURATION_TRIES), ("exit(70)", launcher.TRIES)])
def test_what_fails_at_once_again_and_again_is_given_up(tmp_path, monkeypatch, code, tries):
    monkeypatch.setattr(launcher, "FIRST_PAUSE_S", 0.01)
    with Graph([program("one", code)], log_dir=tmp_path, restart=True) as graph:
        wait_for(lambda: status(graph, "one").state == "given up", "giving up")
        assert status(graph, "one").restarts == tries - 1
        assert f"failed {tries} times in a row" in status(graph, "one").reason


def test_a_crash_and_one_refusal_do_not_end_a_process_that_would_start(tmp_path, monkeypatch):
    monkeypatch.setattr(launcher, "FIRST_PAUSE_S", 0.01)
    count = tmp_path / "starts"
    code = (
        "import pathlib, sys, time\n"
        f"file = pathlib.Path({str(count)!r})\n"
        "starts = len(file.read_text()) if file.exists() else 0\n"
        "file.write_text('x' * (starts + 1))\n"
        "if starts < 2: sys.exit((70, 1)[starts])\n"
        "print('up', flush=True)\n"
        "time.sleep(600)\n"
    )
    with Graph([program("one", code)], log_dir=tmp_path, restart=True) as graph:
        wait_for(lambda: "\nup" in graph.log("one"), "the third start")
        assert (status(graph, "one").state, status(graph, "one").restarts) == ("running", 2)


def test_a_process_that_ends_well_stays_ended(tmp_path):
    with Graph([program("one", "pass")], log_dir=tmp_path, restart=True) as graph:
        assert graph.wait_for_exit("one", DEADLINE_S) == 0
        graph.check()
        assert (status(graph, "one").state, status(graph, "one").restarts) == ("ended", 0)


def test_nothing_outlives_a_launcher_that_is_killed(tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from test_launcher import *\n"
        "with Graph([program('one', PATIENT)], log_dir=sys.argv[2]) as g:\n"
        "    wait_for(lambda: is_up(g, 'one'), 'start')\n"
        "    print(status(g, 'one').pid, flush=True)\n"
        "    time.sleep(600)\n"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        child = int(owner.stdout.readline())
        owner.kill()
    wait_for(lambda: not is_running(child), "the end of the child")


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_domain_reaches_the_process(tmp_path):
    code = "import os; print(os.environ['ROS_DOMAIN_ID'], os.environ['EXTRA'])"
    with Graph([program("one", code, environment={"EXTRA": "x"})], log_dir=tmp_path, domain_id=77) as graph:
        graph.wait_for_exit("one", DEADLINE_S)
        assert graph.tail("one") == "77 x"


def test_two_processes_of_one_name_are_refused(tmp_path):
    with pytest.raises(LaunchError, match="two processes are named 'one'"):
        Graph([program("one", "pass"), program("one", "pass")], log_dir=tmp_path)


def test_parameters_keep_their_type_on_the_command_line():
    process = NodeProcess("p", "e", namespace="left", parameters={"a": True, "b": 1.5, "c": "1", "d": ["ü🤖"]})
    assert process.ros_arguments() == [
        *("--ros-args", "-r", "__ns:=/left"),
        *("-p", "a:=true", "-p", "b:=1.5", "-p", 'c:="1"', "-p", 'd:=["ü🤖"]'),
    ]


def test_the_caller_keeps_its_own_environment(tmp_path):
    before = dict(os.environ)
    with Graph([program("one", "pass")], log_dir=tmp_path, domain_id=5) as graph:
        graph.wait_for_exit("one", DEADLINE_S)
    assert dict(os.environ) == before
