"""What a driver says of a port behind which no robot, or half of one, answers."""

import os
import threading
import time

import pytest
import serial

from hexapod_driver import sensor_board
from hexapod_driver.errors import PortError, StartupError
from hexapod_driver.sensor_board import Frame, Kind

pytestmark = pytest.mark.real_time


def test_missing_servos_are_named_at_once(make_bench, make_driver):
    bench = make_bench()
    bench.electronics.bus.absent |= {2, 18}
    with pytest.raises(StartupError, match=r"expected 18, found 16; .*lf_femur \(id 2\), rr_tibia \(id 18\)"):
        make_driver(bench.paths).link.connect()


def test_a_port_that_does_not_exist(make_driver, tmp_path):
    with pytest.raises(PortError, match="robot does not exist"):
        make_driver([str(tmp_path / "robot")]).link.connect()


def test_a_busy_port(make_bench, make_driver):
    bench = make_bench()
    with serial.Serial(bench.paths[0], exclusive=True), pytest.raises(PortError, match="busy"):
        make_driver(bench.paths).link.connect()


def test_a_file_that_is_no_port(make_driver, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PortError, match="not a serial port"):
        make_driver([str(tmp_path / "file")]).link.connect()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may open every port")
def test_a_forbidden_port(make_driver, tmp_path):
    (tmp_path / "port").touch(mode=0)
    with pytest.raises(PortError, match="usermod"):
        make_driver([str(tmp_path / "port")]).link.connect()


def test_a_port_that_sends_nothing_or_rubbish_is_no_robot(make_bench, make_driver):
    bench = make_bench()
    bench.mute(True)
    with pytest.raises(StartupError, match="not one byte"):
        make_driver(bench.paths).link.connect()
    talking = threading.Event()
    chatter = threading.Thread(target=lambda: [bench.send(b"GPS\r\n\0" * 20) for _ in iter(talking.is_set, True)])
    chatter.start()
    try:
        with pytest.raises(StartupError, match="none of them a frame of this robot"):
            make_driver(bench.paths).link.connect()
    finally:
        talking.set()
        chatter.join()


def test_commands_that_nobody_takes_do_not_keep_the_check_busy(make_bench, make_driver):
    bench = make_bench()
    bench.mute(True)
    driver = make_driver(bench.paths)
    driver.command()
    began, busy = time.monotonic(), time.thread_time()
    with pytest.raises(StartupError):
        driver.link.connect()
    assert time.thread_time() - busy < 0.1 * (time.monotonic() - began)


def test_a_board_of_another_version_is_named(make_bench, make_driver, monkeypatch):
    bench = make_bench()
    bench.mute(True)
    encode = sensor_board.encode

    def old(frame: Frame) -> bytes:
        with monkeypatch.context() as patch:
            patch.setattr(sensor_board, "VERSION", 9)
            return encode(frame)

    talking = threading.Event()
    frame = old(Frame(Kind.SAMPLE, 1))
    chatter = threading.Thread(target=lambda: [bench.send(frame) for _ in iter(talking.is_set, True)])
    chatter.start()
    try:
        with pytest.raises(StartupError, match="version 9, allowed is 1"):
            make_driver(bench.paths).link.connect()
    finally:
        talking.set()
        chatter.join()


def test_one_port_of_a_robot_with_two_is_explained(make_bench, make_driver):
    bench = make_bench(ports=2)
    with pytest.raises(StartupError, match="sensor_port"):
        make_driver(bench.paths[1:]).link.connect()
