"""What a look at the robot behind a port says, and that it leaves the robot as it is."""

import os

import numpy as np
import pytest
import serial

from hexapod_driver import calibration
from hexapod_driver.link import LinkSettings
from hexapod_driver.probe import probe
from tcbi_contract.check import FAULT, OK, Check

pytestmark = pytest.mark.real_time


def look(paths: list[str]) -> dict[str, Check]:
    board = paths[1] if len(paths) == 2 else ""
    settings = LinkSettings(paths[0], 1_000_000, board, 921_600, calibration.load(""))
    return {finding.name: finding for finding in probe(settings)}


def only_fault(paths: list[str]) -> Check:
    (finding,) = look(paths).values()
    assert finding.status == FAULT and finding.remedy
    return finding


@pytest.mark.parametrize("ports", [1, 2])
def test_a_whole_robot_answers_everywhere(make_bench, ports):
    found = look(make_bench(ports, position=0.1).paths)
    assert list(found) == ["sensor board", "servos", "positions", "sensors"]
    assert all(finding.status == OK for finding in found.values())
    assert "18 of 18 joints" in found["positions"].found and "7.4 V" in found["positions"].found
    assert "9.81 m/s^2" in found["sensors"].found and "lf lr rm" in found["sensors"].found


def test_looking_moves_nothing_and_switches_no_torque(make_bench):
    bench = make_bench(position=0.2)
    written: list[str] = []
    body = bench.body
    body.write_goal = lambda *_, **__: written.append("goal")
    body.set_torque = lambda *_, **__: written.append("torque")
    look(bench.paths)
    assert not written
    assert np.all(body.position == 0.2) and body.armings == 0


def test_servos_that_do_not_answer_are_named_and_the_others_read(make_bench):
    bench = make_bench()
    bench.electronics.bus.absent = {1, 7}
    found = look(bench.paths)
    assert found["servos"].status == FAULT and "(id 1)" in found["servos"].found and "(id 7)" in found["servos"].found
    assert found["positions"].status == OK and "16 of 16" in found["positions"].found


def test_a_joint_far_outside_its_range_is_a_fault_of_the_calibration(make_bench):
    found = look(make_bench(position=1.0).paths)["positions"]
    assert found.status == FAULT and "lf_coxa 57 deg" in found.found and "zero_step" in found.remedy


def test_a_silent_port_is_told_from_one_that_sends_rubbish():
    robot, port = os.openpty()
    os.set_blocking(robot, False)
    try:
        assert "not one byte" in only_fault([os.ttyname(port)]).found
    finally:
        os.close(robot)
        os.close(port)


def test_rubbish_is_counted_and_called_so(make_bench):
    bench = make_bench()
    answers = bench.electronics.receive
    bench.electronics.receive = lambda number, data: answers(number, data) and b"\x07rubbish\x00"
    assert "none of them a frame" in only_fault(bench.paths).found


def test_a_busy_port_is_said_to_be_busy(make_bench):
    path = make_bench().paths[0]
    with serial.Serial(path, exclusive=True):
        assert "busy" in only_fault([path]).found


def test_a_port_that_goes_away_under_the_look_is_one_fault(make_bench):
    bench = make_bench()
    answers, asked = bench.electronics.receive, []

    def unplugged(number: int, data: bytes) -> bytes:
        answer = answers(number, data)
        asked.append(answer)
        if len([a for a in asked if a]) == 1:  # the board has said who it is
            return answer
        bench._close_terminals()
        return b""

    bench.electronics.receive = unplugged
    *before, last = look(bench.paths).values()
    assert [finding.name for finding in before] in (["sensor board"], [])  # it was asked again, if this took long
    assert last.name == "link" and last.status == FAULT and "went away" in last.found
