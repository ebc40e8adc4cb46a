"""The table that `./tcbi up` keeps on a terminal, and the lines that it prints elsewhere."""

import re
import sys
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tcbi_bringup import live_view
from tcbi_bringup.expectations import EXPECTATIONS
from tcbi_bringup.graph_monitor import Complaint, GraphMonitor, TopicRate
from tcbi_bringup.launcher import ProcessStatus
from tcbi_contract.messages import STREAM_QOS
from tcbi_contract.names import DIAGNOSTICS, JOINT_COMMANDS, JOINT_STATES

RATES = {JOINT_STATES: TopicRate(JOINT_STATES, 1, 31.4, 0.02), JOINT_COMMANDS: TopicRate(JOINT_COMMANDS, 0, 0.0, None)}
LIMP = Complaint("driver_node: link", "error", "[/dev/rfcomm0] has gone")


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
        return processes, RATES, [LIMP]

    monkeypatch.setattr(live_view, "REFRESH_S", 0.0)
    monkeypatch.setattr(live_view, "LINE_PERIOD_S", 0.0)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    live_view.show("robot: here", look, lambda: len(looks) < 2)
    said = capsys.readouterr().out
    for words in ("robot: here", "driver_node", "4711", "given up", "[/dev/sda1] is full", "31.4 Hz", JOINT_COMMANDS):
        assert words in said, said
    complaints = said.count("error: driver_node: link: [/dev/rfcomm0] has gone")
    assert complaints == 1 or (terminal and complaints), "in lines once, however often it is looked"
    assert ("Ctrl-C stops all" in said) == terminal
    if terminal:
        assert "50 Hz" in said and re.search(r" 30\d s", said), "the contract's rate, and the time since the start"


def test_what_should_always_flow_and_does_not_is_a_fault():
    of = {expected.topic: expected for expected in EXPECTATIONS}
    seen = {(JOINT_STATES, 0.0): "bold red", (JOINT_STATES, 31.4): "yellow", (JOINT_STATES, 50.0): ""}
    for (topic, hz), style in {**seen, (JOINT_COMMANDS, 0.0): "", (DIAGNOSTICS, 0.0): "bold red"}.items():
        assert live_view.rate_style(of[topic], hz) == style, (topic, hz)


@pytest.mark.graph
def test_what_is_not_well_is_heard_until_it_is_well_again(domain, peer):
    status = DiagnosticStatus(name="policy_node", level=DiagnosticStatus.ERROR, message="stopped: no sensors")
    well = DiagnosticStatus(name="sim_node", message="runs")
    with GraphMonitor(domain) as monitor:
        monitor.watch_health()
        publisher = peer.publisher(DIAGNOSTICS, DiagnosticArray, STREAM_QOS)
        peer.node.create_timer(0.1, lambda: publisher.publish(DiagnosticArray(status=[status, well])))
        peer.wait_until(monitor.complaints, "a complaint")
        assert monitor.complaints() == [Complaint("policy_node", "error", "stopped: no sensors")]
        status.level = DiagnosticStatus.OK
        peer.wait_until(lambda: not monitor.complaints(), "the end of it")
