"""The driver's link against the emulated electronics: readings, commands, resets, a link that is lost or disturbed."""

import time

import numpy as np
import pytest

from hexapod_driver import feetech
from tests.driver.linked_driver import ZERO, Commander

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize("ports", [1, 2])
def test_joints_and_board_come_fifty_times_a_second(make_bench, make_driver, until, ports: int):
    bench = make_bench(ports, position=0.1)
    driver = make_driver(bench.paths).start()
    until(lambda: len(driver.joints) >= 100 and len(driver.board) >= 100, "a hundred readings")
    for readings in (driver.joints, driver.board):
        stamps = np.array([r.stamp_ns for r in readings[10:]]) / 1e9
        assert np.median(np.diff(stamps)) == pytest.approx(0.02, abs=0.003)
        assert 0 <= time.time() - stamps[-1] < 10
    assert driver.joints[-1].position == pytest.approx((0.1,) * 18, abs=0.001)
    assert driver.board[-1].sample.contact == (True, False, True, False, True, False)
    assert driver.board[-1].sample.angular_velocity == pytest.approx((0.1, 0.2, 0.3))


def test_with_two_ports_a_robot_whose_power_the_board_has_cut_starts_and_is_found_again(make_bench, make_driver, until):
    bench = make_bench(ports=2)

    def without_power() -> bool:
        return bench.electronics.bus.receive(feetech.encode(1, feetech.Instruction.PING)) == b""

    until(without_power, "the watchdog, for nobody has spoken to the board")
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    assert not bench.body.torque.any()
    bench.unplug()
    until(lambda: driver.link.robot is None and without_power(), "the loss, and the watchdog again")
    bench.plug_in()
    until(lambda: driver.link.robot is not None and driver.link.reconnects == 1, "the robot again")
    assert not bench.body.torque.any()


@pytest.mark.parametrize("ports", [1, 2])
def test_commands_move_all_joints_on_both_sides(make_bench, make_driver, until, ports: int):
    bench = make_bench(ports)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    target = tuple(np.linspace(-0.3, 0.3, 18))
    with Commander(driver, target):
        until(lambda: np.allclose(bench.body.position, target, atol=0.001), "the target")
        assert bench.body.torque.all()
    until(lambda: np.allclose(driver.joints[-1].position, target, atol=0.002), "the reading")


def test_an_unplugged_link_is_found_again_and_the_robot_stays_limp_until_a_reset(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        bench.unplug()
        until(lambda: not bench.body.torque.any(), "limp by the watchdog")
        until(lambda: driver.link.robot is None, "the loss to be noticed")
        assert any("went away" in text for text in driver.reports)
        seen = len(driver.joints)
        bench.plug_in()
        until(lambda: len(driver.joints) > seen + 10, "readings again")
        until(lambda: any("reset_episode" in text for text in driver.refusals), "commands to be refused")
        assert not bench.body.torque.any()
        driver.reset()
        until(lambda: bool(driver.answers), "the reset's answer")
        assert driver.answers[0][0], driver.answers
        until(lambda: bool(bench.body.torque.all()), "torque again")
    assert driver.link.reconnects == 1


def test_a_robot_that_falls_silent_on_an_open_port_is_lost_and_found(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    bench.mute(True)
    until(lambda: driver.link.robot is None, "the loss to be noticed")
    assert "no sample" in driver.link.state or "no answer" in driver.link.state
    bench.mute(False)
    until(lambda: driver.link.robot is not None and driver.link.reconnects == 1, "the robot again")


def test_rubbish_among_the_bytes_changes_nothing_but_a_counter(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    rng = np.random.default_rng(5)
    for _ in range(50):
        seen = len(driver.joints)
        bench.send(rng.bytes(int(rng.integers(1, 200))))
        until(lambda seen=seen: len(driver.joints) > seen, "readings to go on")
    assert driver.link.robot is not None
    if not driver.link.reconnects:  # which starts the count anew, should a busy machine have stalled the robot
        assert driver.link.robot.wire.bad_frames > 10
    assert all(r.position == pytest.approx(ZERO, abs=1e-3) for r in driver.joints)


def test_a_restarted_board_goes_on_and_stamps_stay_right(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: len(driver.board) > 20, "samples")
    for _ in range(4):  # a busy machine may stall the robot for as long as a lost link lasts
        reconnects = driver.link.reconnects
        bench.restart_board()
        seen = len(driver.board)
        until(lambda seen=seen: len(driver.board) > seen + 20, "samples again")
        assert abs(time.time() - driver.board[-1].stamp_ns / 1e9) < 5
        if driver.link.reconnects == reconnects:
            return
    pytest.fail("each restart of the board cost the link")


def test_a_first_command_far_away_is_approached_slowly(make_bench, make_driver, until):
    bench = make_bench(position=-0.5)
    driver = make_driver(bench.paths, approach_speed=0.5).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver, (0.5,) * 18):
        until(lambda: bench.body.position[0] > 0.45, "the target")
    moved = np.array([r.position[0] for r in driver.joints])
    stamps = np.array([r.stamp_ns for r in driver.joints]) / 1e9
    begin, end = np.argmax(moved > -0.4), np.argmax(moved > 0.4)
    assert stamps[end] - stamps[begin] > 0.9 * 0.8 / 0.5


def test_a_reset_moves_slowly_and_a_stuck_leg_fails_it_by_name(make_bench, make_driver, until):
    bench = make_bench(position=0.2)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    bench.body.stuck.add(8)
    driver.reset()
    until(lambda: bool(driver.answers), "the answer")
    success, text = driver.answers.pop()
    assert not success and "lr_tibia" in text
    until(lambda: not bench.body.torque.any(), "limp")


def test_a_reset_waits_for_a_reading_of_the_joints_but_not_for_ever(make_bench, make_driver, until):
    bench = make_bench(position=0.1)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    for comes_back in (True, False):
        bench.electronics.bus.absent.add(7)
        until(lambda: not driver.link.safety.knows_joints(time.monotonic()), "the reading to be old")
        driver.reset()
        if comes_back:
            bench.electronics.bus.absent.clear()
        until(lambda: bool(driver.answers), "the answer")
        success, text = driver.answers.pop()
        assert success == comes_back, text
    assert "where the joints are is not known" in text
