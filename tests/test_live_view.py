"""The table that `./tcbi up` keeps on a terminal, and the lines that it prints elsewhere."""

import re
import sys
import time

import pytest

from tcbi_bringup import live_view
from tcbi_bringup.graph_monitor import TopicRate
from tcbi_bringup.launcher import ProcessStatus
from tcbi_contract.names import JOINT_COMMANDS, JOINT_STATES

RATES = {JOINT_STATES: TopicRate(JOINT_STATES, 1, 31.4, 0.02), JOINT_COMMANDS: TopicRate(JOINT_COMMANDS, 0, 0.0, None)}


@pytest.mark.parametrize("terminal", [True, False])
def test_what_runs_and_what_was_given_up_is_shown_on_a_terminal_and_in_lines(terminal, monkeypatch, capsys):
    looks: list[int] = []

    processes = [
        ProcessStatus("driver_node", "running", pid=4711, restarts=2, exit_code=70, started=time.time() - 300),
        ProcessStatus("recorder_node", "given up", exit_code=1, reason="recorder_node failed: [/dev/sda1] is full"),
        ProcessStatus("policy_node", "waiting"),
    ]

    def look():
        looks.append(1)
        return processes, RATES

    monkeypatch.setattr(live_view, "REFRESH_S", 0.0)
    monkeypatch.setattr(live_view, "LINE_PERIOD_S", 0.0)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    live_view.show("robot: here", look, lambda: len(looks) < 2)
    said = capsys.readouterr().out
    for words in ("robot: here", "driver_node", "4711", "given up", "[/dev/sda1] is full", "31.4 Hz", JOINT_COMMANDS):
        assert words in said, said
    assert ("Ctrl-C stops all" in said) == terminal
    if terminal:
        assert "50 Hz" in said and re.search(r" 30\d s", said), "the contract's rate, and the time since the start"
