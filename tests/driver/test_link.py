"""The driver's link against the emulated electronics: what happens when anything between computer and robot fails."""

import threading
import time

import numpy as np
import pytest

from hexapod_driver import feetech
from hexapod_driver.errors import StartupError
from hexapod_driver.status import Status, statuses
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_contract.safety import Mode
from tests.driver.linked_driver import ZERO, Driver

pytestmark = pytest.mark.real_time


class Commander:
    """Commands five times a second from a thread of its own, as a policy that never gives up."""

    def __init__(self, driver: Driver, target=ZERO) -> None:
        self.target = target
        self.last_s = 0.0  # when it last commanded, on the steady clock
        self._driver, self._stop = driver, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            self._command()

    def _command(self) -> None:
        self.last_s = time.monotonic()
        self._driver.command(self.target)

    def __enter__(self) -> "Commander":
        self._command()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def safety_status(driver: Driver) -> Status:
    return statuses(driver.link, 0, "")[-1]


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
    until(lambda: bench.body.armings == 1, "torque")
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
