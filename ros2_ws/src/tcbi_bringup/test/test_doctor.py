"""Findings of the doctor: what is judged well or ill, and that each ill has its remedy."""

import os
import pty

import pytest

from tcbi_bringup import doctor
from tcbi_bringup.expectations import EXPECTATIONS, judge_rate
from tcbi_bringup.graph_check import nodes_check, topic_check
from tcbi_bringup.graph_monitor import TopicRate, rate

JOINT_STATES = EXPECTATIONS[0]
RIGHT_TYPE = [JOINT_STATES.type_name]


def judge(seen: TopicRate, types=None, simulated=False, has_robot=True) -> doctor.Check:
    return topic_check(JOINT_STATES, RIGHT_TYPE if types is None else types, seen, simulated, has_robot)


def test_this_environment_is_well(tmp_path):
    checks = [*doctor.environment_checks(tmp_path)]
    assert not [c for c in checks if c.status == doctor.FAULT]
    assert {"python", "packages", "interfaces", "workspace", "disk", "store", "rendering", "domain", "clock"} == {
        c.name for c in checks
    }


def test_a_port_that_does_not_exist_is_a_fault_with_a_remedy(tmp_path):
    check = doctor.port_check(str(tmp_path / "ttyUSB9"))
    assert (check.status, check.found) == (doctor.FAULT, "does not exist")
    assert check.remedy


def test_a_port_is_well_when_free_and_a_fault_when_held_by_another():
    import serial

    side, port = pty.openpty()
    name = os.ttyname(port)
    try:
        assert doctor.port_check(name).status == doctor.OK
        with serial.Serial(name, exclusive=True):
            check = doctor.port_check(name)
        assert (check.status, check.found) == (doctor.FAULT, "busy")
        assert "fuser" in check.remedy
    finally:
        os.close(side)
        os.close(port)


def test_a_port_that_was_not_asked_for_is_no_fault_when_held_or_forbidden(monkeypatch):
    import serial
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    side, port = pty.openpty()
    name = os.ttyname(port)
    monkeypatch.setattr(list_ports, "comports", lambda: [ListPortInfo(name)])
    try:
        with serial.Serial(name, exclusive=True):  # as by the driver of a running graph
            (check,) = doctor.port_checks()
        assert (check.status, check.found) == (doctor.OK, "in use")
        monkeypatch.setattr(doctor.os, "access", lambda *_: False)
        (check,) = doctor.port_checks()
        assert (check.status, check.found) == (doctor.WARNING, "no permission") and "dialout" in check.remedy
        assert doctor.port_check(name).status == doctor.FAULT
    finally:
        os.close(side)
        os.close(port)


def test_a_file_is_no_port(tmp_path):
    file = tmp_path / "file"
    file.write_text("x")
    assert doctor.port_check(str(file)).status == doctor.FAULT


def test_a_clock_of_1970_is_a_fault():
    assert doctor.clock_check(1000.0).status == doctor.FAULT
    assert doctor.clock_check(doctor.EARLIEST_CLOCK + 1.0).status == doctor.OK


def test_a_domain_that_is_none_is_a_fault(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    check = doctor.domain_check()
    assert check.status == doctor.FAULT and "'many'" in check.found


def test_little_space_is_a_warning_and_none_a_fault(tmp_path, monkeypatch):
    for free, status in ((3e9, doctor.OK), (1e9, doctor.WARNING), (1e8, doctor.FAULT)):
        monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _, free=free: type("Usage", (), {"free": free}))
        assert doctor.space_check(tmp_path / "not" / "yet" / "there").status == status


@pytest.mark.parametrize(
    ("seen", "status"),
    [
        (TopicRate("joint_states", 1, 50.0, 0.01), doctor.OK),
        (TopicRate("joint_states", 1, 30.0, 0.01), doctor.WARNING),
        (TopicRate("joint_states", 2, 100.0, 0.01), doctor.FAULT),
        (TopicRate("joint_states", 0, 0.0, None), doctor.FAULT),
        (TopicRate("joint_states", 1, 0.0, None), doctor.FAULT),
    ],
)
def test_a_sensor_topic_is_judged_by_publishers_and_rate(seen, status):
    check = judge(seen)
    assert check.status == status
    assert bool(check.remedy) == (status != doctor.OK)


def test_rates_by_the_wall_are_not_judged_on_a_simulated_clock():
    assert judge(TopicRate("joint_states", 1, 700.0, 0.01), simulated=True).status == doctor.OK
    assert judge(TopicRate("joint_states", 1, 0.0, None), simulated=True).status == doctor.OK


def test_silence_is_well_where_no_robot_is():
    assert judge(TopicRate("joint_states", 0, 0.0, None), types=[], has_robot=False).status == doctor.OK


def test_a_topic_of_another_type_is_a_fault():
    check = judge(TopicRate("joint_states", 1, 50.0, 0.0), types=["std_msgs/msg/String"])
    assert check.status == doctor.FAULT and JOINT_STATES.type_name in check.remedy


def test_a_robot_and_a_simulation_at_once_are_a_fault():
    assert nodes_check(["driver_node", "sim_node"]).status == doctor.FAULT
    assert nodes_check(["policy_node"]).status == doctor.WARNING
    assert nodes_check(["driver_node", "policy_node"]).status == doctor.OK


def test_a_rate_counts_the_last_seconds_only():
    assert rate([0.02 * i for i in range(100)], now=2.0) == pytest.approx(50.0)
    assert rate([0.02 * i for i in range(100)], now=60.0) == 0.0
    assert rate([1.0], now=1.0) == 0.0
    assert judge_rate(50.0, 46.0) and not judge_rate(50.0, 40.0)
