"""What makes a robot limp, and that all servos then are, whatever fails between computer and robot."""

import time

import numpy as np
import pytest

from hexapod_driver import feetech
from hexapod_driver.errors import StartupError
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_contract.safety import Mode
from tests.driver.linked_driver import ZERO, Commander, safety_status

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize("ports", [1, 2])
def test_silence_makes_the_robot_limp(make_bench, make_driver, until, ports: int):
    bench = make_bench(ports)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    driver.command()
    until(lambda: bench.body.armings == 1, "torque")
    until(lambda: not bench.body.torque.any(), "limp")
    assert "no command in time" in driver.link.safety.reason
    driver.command()
    until(lambda: bench.body.armings == 2, "torque again")


@pytest.mark.parametrize("ports", [1, 2])
def test_a_driver_that_dies_leaves_a_limp_robot(make_bench, make_driver, until, ports: int):
    """The link's thread stops dead, as after a SIGKILL: the board's watchdog is all that is left."""
    bench = make_bench(ports)
    driver = make_driver(bench.paths)
    driver.link.connect()
    robot = driver.link.robot
    until(lambda: robot.receive() or robot.act() or bool(driver.joints), "a reading")
    robot.command(ZERO, 0.2)
    until(lambda: robot.receive() or bench.body.armings == 1, "torque")  # behind a question that may be on the bus
    until(lambda: not bench.body.torque.any(), "limp without a word from the driver")


@pytest.mark.parametrize("ports", [1, 2])
@pytest.mark.parametrize("fault", ["silence", "unplugged", "stop"])
def test_the_robot_is_limp_two_control_periods_after_a_fault(make_bench, make_driver, until, ports: int, fault: str):
    """To which a cycle of the link and the wire are added. The stop waits for nothing."""
    allowed = {"silence": (0.4, 0.5), "unplugged": (0.2, 0.5), "stop": (0.0, 0.1)}[fault]
    took = []
    for _ in range(5):  # a busy machine may hold up the robot or who watches it
        bench = make_bench(ports)
        driver = make_driver(bench.paths).start()
        until(lambda driver=driver: bool(driver.joints), "a reading")
        with Commander(driver) as commander:
            until(lambda bench=bench: bool(bench.body.torque.all()), "torque")
            if fault != "silence":
                began = time.monotonic()
                bench.unplug() if fault == "unplugged" else driver.stop()
                until(lambda bench=bench: not bench.body.torque.any(), "limp")
        if fault == "silence":
            began = commander.last_s
            until(lambda bench=bench: not bench.body.torque.any(), "limp")
        took.append(bench.body.limp_s - began)
        if allowed[0] <= took[-1] <= allowed[1]:
            return
    pytest.fail(f"limp after {took} s, allowed is {allowed}")


@pytest.mark.parametrize("ports", [1, 2])
def test_a_servo_that_stops_answering_makes_the_robot_limp_and_nothing_is_made_up(
    make_bench, make_driver, until, ports: int
):
    bench = make_bench(ports)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        bench.electronics.bus.absent.add(7)
        until(lambda: driver.link.safety.mode is Mode.LIMP, "limp")
        hears = np.arange(1, 19) != 7  # which loses its torque only where a stalled machine lets the power be cut
        until(lambda: not bench.body.torque[hears].any(), "torque off but for the one that hears nothing")
        seen, samples = len(driver.joints), len(driver.board)
        until(lambda: len(driver.board) > samples + 10, "the board to go on")
        assert len(driver.joints) == seen
        assert driver.link.robot.health.silent_servos == (7,)
        assert driver.link.safety.needs_reset


def test_torque_that_a_dead_servo_bus_keeps_is_cut_by_the_board_and_comes_back_after_a_reset(
    make_bench, make_driver, until
):
    """Two ports: the board is all that is left, so it must not be kept alive."""
    bench = make_bench(2)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        hears, bench.electronics.bus.receive = bench.electronics.bus.receive, lambda data: b""
        silent = time.monotonic()
        until(lambda: not bench.body.torque.any(), "the power cut")
        assert bench.body.limp_s - silent < 3.0, "0.4 s without a reading, 0.5 s to confirm, 0.4 s of the watchdog"
        assert "torque not confirmed to be off by any servo" in safety_status(driver).message
        bench.electronics.bus.receive = hears
        seen = len(driver.joints)
        until(lambda: len(driver.joints) > seen, "readings, once the board is found again")
        assert not bench.body.torque.any()
        until(lambda: "torque_unconfirmed" not in safety_status(driver).values, "the servos' word")
        driver.reset()
        until(lambda: bool(driver.answers), "the reset's answer")
        assert driver.answers[0][0], driver.answers
        until(lambda: bool(bench.body.torque.all()), "torque again")


def test_one_mute_servo_has_the_power_of_all_cut(make_bench, make_driver, until):
    bench = make_bench(2)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        bench.electronics.bus.absent.add(7)
        until(lambda: not bench.body.torque[np.arange(1, 19) != 7].any(), "torque off but for the one")
        until(lambda: bool(safety_status(driver).values.get("torque_unconfirmed")), "the warning")
        until(lambda: not bench.body.torque.any(), "the power cut")


@pytest.mark.parametrize("ports", [1, 2])
def test_a_limp_that_all_servos_confirm_is_not_left_to_the_watchdog(make_bench, make_driver, until, ports: int):
    """Not at the start, and not later, when servos of the limp robot fall silent."""
    bench = make_bench(ports)
    driver = make_driver(bench.paths).start()
    for limps in (0, 1):
        until(lambda: len(driver.joints) > 100, "two seconds, in which the servos confirm")
        for _ in range(100):
            assert "torque_unconfirmed" not in safety_status(driver).values
            time.sleep(0.01)
        if not limps:
            driver.command()
            until(lambda: bench.body.armings == 1, "torque")
            until(lambda: not bench.body.torque.any(), "limp")
            driver.readings.clear()
    samples = len(driver.board)
    bench.electronics.bus.absent.add(7)
    until(lambda: len(driver.board) > samples + 75, "a second and a half")
    assert not any(reading.sample.watchdog_tripped for reading in driver.board)


def test_a_servo_that_loses_its_torque_makes_all_limp(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        bench.electronics.bus.receive(feetech.torque([4], False))
        until(lambda: not bench.body.torque.any(), "all limp")
    assert "lm_coxa (id 4)" in driver.link.safety.reason


def test_an_emergency_stop_is_confirmed_by_the_servos_and_latched(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        driver.stop()
        until(lambda: bool(driver.answers), "the answer")
        assert driver.answers.pop() == (True, "all 18 servos confirm that their torque is off")
        assert not bench.body.torque.any()
        driver.reset()
        until(lambda: bool(driver.answers), "the reset to be refused")
        assert "emergency_stop/release" in driver.answers.pop()[1]
        driver.release()
        until(lambda: bool(driver.answers), "the release")
        assert driver.answers.pop()[0]
        until(lambda: any("reset_episode" in text for text in driver.refusals), "commands to be refused still")
        assert not bench.body.torque.any()
        driver.reset()
        until(lambda: bool(driver.answers), "the reset")
        assert driver.answers.pop()[0]
        assert bench.body.torque.all()


def test_an_emergency_stop_without_confirmation_says_so_and_stands_through_a_lost_link(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    bench.unplug()
    driver.stop()
    until(lambda: bool(driver.answers), "the answer")
    success, text = driver.answers.pop()
    assert not success and "cut the power" in text
    bench.plug_in()
    until(lambda: driver.link.robot is not None, "the robot again")
    assert driver.link.safety.mode is Mode.STOPPED


class DeadBoard:
    """A sensor board without power, whose watchdog is dead with it."""

    def receive(self, data: bytes) -> bytes:
        return b""

    def tick(self) -> bytes:
        return b""


def test_a_board_that_dies_beside_a_sound_servo_bus_leaves_no_torque(make_bench, make_driver, until):
    bench = make_bench(2)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        bench.electronics.board = DeadBoard()
        died = time.monotonic()
        until(lambda: not bench.body.torque.any(), "torque off")
    assert bench.body.limp_s - died < 2 * CONTROL_PERIOD_S + 0.1, "two control periods, and a moment to say it"
    assert driver.link.safety.needs_reset


def test_a_robot_whose_board_is_dead_at_the_start_loses_its_torque_all_the_same(make_bench, make_driver):
    bench = make_bench(2)
    bench.body.torque[:] = True
    bench.electronics.board = DeadBoard()
    with pytest.raises(StartupError, match="sensor board"):
        make_driver(bench.paths).start()
    assert not bench.body.torque.any()


def test_an_emergency_stop_that_no_servo_confirms_is_left_to_the_boards_watchdog(make_bench, make_driver, until):
    bench = make_bench(2)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    with Commander(driver):
        until(lambda: bool(bench.body.torque.all()), "torque")
        hears, bench.electronics.bus.receive = bench.electronics.bus.receive, lambda data: b""
        driver.stop()
        until(lambda: bool(driver.answers), "the answer")
        assert not driver.answers.pop()[0]
        until(lambda: not bench.body.torque.any(), "the power cut")
        samples = len(driver.board)
        until(lambda: len(driver.board) > samples + 60, "a second in which the power stays cut")
        assert not hears(feetech.encode(1, feetech.Instruction.PING))
        driver.release()
        bench.electronics.bus.receive = hears
        seen = len(driver.joints)
        until(lambda: len(driver.joints) > seen, "readings, with power again")
    assert not bench.body.torque.any()


def test_an_emergency_stop_ends_a_reset_that_waits(make_bench, make_driver, until):
    bench = make_bench(position=0.1)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    bench.electronics.bus.absent.add(7)
    until(lambda: not driver.link.safety.knows_joints(time.monotonic()), "the reading to be old")
    driver.reset()
    driver.stop()
    until(lambda: bool(driver.answers), "the reset's answer")
    success, text = driver.answers[0]
    assert not success and "emergency stop" in text
    driver.release()
    bench.electronics.bus.absent.clear()
    seen = len(driver.joints)
    until(lambda: len(driver.joints) > seen + 20, "readings again")
    assert not bench.body.torque.any()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_fault_of_the_driver_itself_makes_the_robot_limp(make_bench, make_driver, until):
    bench = make_bench()
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    driver.command()
    until(lambda: bench.body.armings == 1, "torque")
    driver.link.post(lambda _: 1 / 0, driver.refusals.append)
    until(lambda: not driver.link.alive, "the thread's end")
    assert not bench.body.torque.any()


@pytest.mark.parametrize("ports", [1, 2])
def test_closing_takes_the_torque_off(make_bench, make_driver, until, ports: int):
    bench = make_bench(ports)
    driver = make_driver(bench.paths).start()
    until(lambda: bool(driver.joints), "a reading")
    driver.command()
    until(lambda: bench.body.armings == 1, "torque")
    driver.link.close()
    assert not bench.body.torque.any()
    assert not any("did not confirm" in text for text in driver.reports)
