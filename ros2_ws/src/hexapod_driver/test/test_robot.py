"""The cycle of one connection, on a wire whose answers the test gives."""

import time
from types import SimpleNamespace

import pytest

from hexapod_driver import calibration, feetech
from hexapod_driver.feetech import Packet
from hexapod_driver.link import Link, LinkSettings
from hexapod_driver.posture import PostureGoal
from hexapod_driver.readings import Health
from hexapod_driver.robot import Robot
from hexapod_driver.status import statuses
from hexapod_driver.wire import BusReply, Request, Wire
from tcbi_contract.safety import Limits, Safety

CALIBRATION = calibration.load("")
SERVOS = CALIBRATION.servos
ZERO = (0.0,) * len(SERVOS)
SETTINGS = LinkSettings("", 1_000_000, "", 921_600, CALIBRATION)
LONG_S = 20.0  # more than any test lasts
TORQUE_QUESTION = feetech.sync_read(SERVOS, feetech.TORQUE_ENABLE, 1)


class Told(Wire):
    """A wire that keeps every request, and says what it is told to."""

    def __init__(self) -> None:
        super().__init__(time.time_ns)
        self.requests: list[Request] = []

    def close(self) -> None:
        pass

    def answer(self, request: Request, params: bytes) -> None:
        packets = tuple(Packet(servo, 0, params) for servo in request.servos)
        self.events.append(BusReply(request.tag, packets, time.time_ns()))

    def _submit(self, request: Request) -> None:
        self.requests.append(request)

    def _wait(self, timeout_s: float) -> None:
        pass

    def _board_port(self) -> SimpleNamespace:
        return SimpleNamespace(write=lambda data: None)


@pytest.fixture
def wire() -> Told:
    return Told()


@pytest.fixture
def safety() -> Safety:
    """It knows where the joints are, and does not mind a machine that stands still."""
    safety = Safety(Limits(silence_s=LONG_S))
    safety.measured(time.monotonic(), ZERO)
    return safety


@pytest.fixture
def robot(wire: Told, safety: Safety, monkeypatch: pytest.MonkeyPatch) -> Robot:
    monkeypatch.setattr("hexapod_driver.robot.CONFIRM_S", LONG_S)
    monkeypatch.setattr("hexapod_driver.robot.TORQUE_CHECK_S", 1e-3)
    return Robot(wire, CALIBRATION, safety, lambda reading: None, 400)


def last_torque_question(wire: Told) -> Request | None:
    questions = [request for request in wire.requests if request.packet == TORQUE_QUESTION]
    return questions[-1] if questions else None


def test_an_emergency_stop_is_not_confirmed_by_the_answer_to_an_older_question(robot, wire):
    told: list[tuple[bool, str]] = []
    while (before := last_torque_question(wire)) is None:
        robot.act()
    robot.command(ZERO, 0.2)
    robot.stop(lambda *answer: told.append(answer))
    after = last_torque_question(wire)
    for question, answers in ((before, 0), (after, 1)):
        wire.answer(question, b"\x00")
        robot.receive()
        robot.act()
        assert len(told) == answers
    assert told[0][0]


def test_a_reset_that_went_limp_is_answered_when_another_begins_at_once(robot, safety):
    told: list[tuple[str, bool, str]] = []
    robot.begin_posture(PostureGoal(ZERO, 0.1), lambda *answer: told.append(("first", *answer)))
    safety.go_limp("no command in time")
    robot.begin_posture(PostureGoal(ZERO, 0.1), lambda *answer: told.append(("second", *answer)))
    assert told == [("first", False, "interrupted: no command in time")]
    robot.abandon("the end")
    assert [name for name, *_ in told] == ["first", "second"]


class Replaced(Health):
    """Health that another thread replaces between two looks at it."""

    def __init__(self, looks: list[dict[int, int]]) -> None:
        self._looks = looks
        super().__init__()

    @property
    def temperature(self) -> dict[int, int]:
        return self._looks.pop(0) if self._looks else {}

    @temperature.setter
    def temperature(self, value: dict[int, int]) -> None:
        pass


def test_a_status_looks_once_at_what_another_thread_replaces(robot):
    robot.health = Replaced([{1: 31}])
    link = Link(SETTINGS, lambda reading: None, time.time_ns, lambda text: None)
    link.robot = robot
    _, servos, _ = statuses(link, 0, "")
    assert servos.values == {"temperature_C/lf_coxa": "31"}
