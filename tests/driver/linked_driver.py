"""A driver's link to a robot, without its node."""

import threading
import time

from hexapod_driver import calibration
from hexapod_driver.link import Link, LinkSettings
from hexapod_driver.posture import PostureGoal
from hexapod_driver.readings import BoardReading, JointReading
from hexapod_driver.status import Status, statuses
from tcbi_contract.safety import Limits

ZERO = (0.0,) * 18


class Driver:
    """A link and all that it said."""

    def __init__(self, paths: list[str], **limits: float) -> None:
        self.readings: list = []
        self.reports: list[str] = []
        self.refusals: list[str] = []
        self.answers: list[tuple[bool, str]] = []
        board = paths[1] if len(paths) == 2 else ""
        settings = LinkSettings(paths[0], 1_000_000, board, 921_600, calibration.load(""), Limits(**limits))
        self.link = Link(settings, self.readings.append, time.time_ns, self.reports.append)

    def start(self) -> "Driver":
        self.link.connect()
        self.link.start()
        return self

    @property
    def joints(self) -> list[JointReading]:
        return [r for r in self.readings if isinstance(r, JointReading)]

    @property
    def board(self) -> list[BoardReading]:
        return [r for r in self.readings if isinstance(r, BoardReading)]

    def command(self, target=ZERO, duration: float = 0.2) -> None:
        self.link.post(lambda robot: robot.command(target, duration), self.refusals.append)

    def reset(self, target=ZERO, tolerance: float = 0.1) -> None:
        def answer(success: bool, text: str) -> None:
            self.answers.append((success, text))

        self.link.post(
            lambda r: r.begin_posture(PostureGoal(tuple(target), tolerance), answer), lambda text: answer(False, text)
        )

    def stop(self) -> None:
        self.link.emergency_stop(lambda success, text: self.answers.append((success, text)))

    def release(self) -> None:
        self.link.release(lambda success, text: self.answers.append((success, text)))


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
