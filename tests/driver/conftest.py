"""The emulated robot's electronics before joints that do as they are told, on a port that can be unplugged."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hexapod_driver import calibration
from tcbi_bringup.emulated_robot.body import BodyState
from tcbi_bringup.emulated_robot.firmware import Electronics
from tcbi_bringup.emulated_robot.port import PseudoTerminal, exchange
from tests.driver.linked_driver import Driver

DEADLINE_S = 20.0


class KinematicBody:
    """Joints that follow their ramps exactly, and stay where they are without torque.

    Attributes:
      torque: (18,) bool.
      armings: how often all torque has come on; a busy test may miss the moment itself.
      limp_s: when the last torque went off, on the steady clock.
      stuck: joints that do not move.
    """

    def __init__(self, position: float = 0.0) -> None:
        self.torque = np.zeros(18, bool)
        self.armings = 0
        self.limp_s = 0.0
        self.stuck: set[int] = set()
        self._from = np.full(18, position)
        self._goal = np.full(18, position)
        self._begin = np.zeros(18)
        self._duration = np.zeros(18)
        self._started = time.monotonic()

    @property
    def position(self) -> np.ndarray:
        share = np.clip((time.monotonic() - self._begin) / np.maximum(self._duration, 1e-9), 0, 1)
        return self._from + share * (self._goal - self._from)

    def write_goal(self, servo_index: int, goal_rad: float, duration_s: float, speed_rad_s: float = 0.0) -> None:
        if servo_index in self.stuck:
            return
        here = self.position[servo_index]
        if duration_s == 0 and speed_rad_s > 0:
            duration_s = abs(goal_rad - here) / speed_rad_s
        self._set(servo_index, here, goal_rad, duration_s)

    def set_torque(self, servo_index: int, on: bool) -> None:
        here = self.position[servo_index]
        self._set(servo_index, here, here, 0.0)
        was_armed, had_torque = self.torque.all(), self.torque.any()
        self.torque[servo_index] = on
        if had_torque and not self.torque.any():
            self.limp_s = time.monotonic()
        self.armings += bool(self.torque.all() and not was_armed)

    def read(self) -> BodyState:
        return BodyState(
            time_s=time.monotonic() - self._started,
            joint_position=self.position,
            voltage=7.4,
            temperature=np.full(18, 31.0),
            load=np.zeros(18),
            attitude=np.array([0.0, 0.0, 0.0, 1.0]),
            angular_velocity=np.array([0.1, 0.2, 0.3]),
            linear_acceleration=np.array([0.0, 0.0, 9.81]),
            contact=np.array([True, False, True, False, True, False]),
        )

    def _set(self, index: int, here: float, goal: float, duration_s: float) -> None:
        self._from[index], self._goal[index] = here, goal
        self._begin[index], self._duration[index] = time.monotonic(), duration_s


class Bench:
    """A robot on pseudo-terminals, run by a thread.

    Attributes:
      paths: the ports' links, which stay the same when the robot is unplugged and plugged in again.
    """

    def __init__(self, folder: Path, ports: int, position: float) -> None:
        self.body = KinematicBody(position)
        self.electronics = Electronics(self.body, calibration.load(""), ports)
        self.links = [folder / f"robot{i}" for i in range(ports)]
        self.paths = [str(link) for link in self.links]
        self._mute = False
        self._terminals: list[PseudoTerminal] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.plug_in()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def plug_in(self) -> None:
        with self._lock:
            self._terminals = [PseudoTerminal(link) for link in self.links]

    def unplug(self) -> None:
        with self._lock:
            self._close_terminals()

    def send(self, data: bytes, port: int = 0) -> None:
        """Bytes that the robot never meant to send."""
        with self._lock:
            self._terminals[port].write(data)

    def mute(self, on: bool) -> None:
        """Whether the robot hears and answers nothing, with its ports open."""
        with self._lock:
            self._mute = on

    def restart_board(self) -> None:
        with self._lock:
            self.electronics.board.restart()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._close_terminals()

    def _close_terminals(self) -> None:
        for terminal in self._terminals:
            terminal.close()
        self._terminals = []

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                if self._terminals and not self._mute:
                    exchange(self.electronics, self._terminals, 0.002)
                elif self._terminals:
                    for terminal in self._terminals:
                        terminal.read()
                    self.electronics.tick()
                else:
                    self.electronics.tick()
            time.sleep(0.0005)  # lets the other side have the lock


@pytest.fixture
def make_bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """`make_bench(ports=1, position=0.0)`."""
    benches: list[Bench] = []

    def make(ports: int = 1, position: float = 0.0) -> Bench:
        folder = tmp_path / f"bench{len(benches)}"
        folder.mkdir()
        benches.append(Bench(folder, ports, position))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


@pytest.fixture
def until() -> Callable[..., None]:
    """`until(condition, what)` waits for a condition and fails after a deadline."""

    def wait(condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"not within {DEADLINE_S} s: {what}"
            time.sleep(0.005)

    return wait


@pytest.fixture
def make_driver() -> Iterator[Callable[..., Driver]]:
    drivers: list[Driver] = []

    def make(paths: list[str], **limits: float) -> Driver:
        drivers.append(Driver(paths, **limits))
        return drivers[-1]

    yield make
    for driver in drivers:
        driver.link.close()
