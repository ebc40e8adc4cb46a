"""The emulated robot on a clock, and the experimenter's socket beside it."""

import json
import logging
import socket
from pathlib import Path

import numpy as np
import pytest

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.experimenter import ExperimenterClient, ExperimenterServer, answer
from tcbi_bringup.emulated_robot.live_body import LiveBody
from tcbi_bringup.emulated_robot.mechanics import Box, Scene
from tcbi_bringup.emulated_robot.physics import Specimen


class Clock:
    """A steady clock that a test moves; looking at it may take time."""

    def __init__(self, look_s: float = 0.0) -> None:
        self.now, self.look_s = 100.0, look_s

    def __call__(self) -> float:
        self.now += self.look_s
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def body(clock: Clock) -> LiveBody:
    return LiveBody(Specimen.of(3, "none"), clock=clock)


def test_the_robots_clock_follows_the_steady_clock(body: LiveBody, clock: Clock) -> None:
    for _ in range(10):
        clock.now += 0.02
        state = body.read()
    assert state.time_s == pytest.approx(0.2, abs=2e-3) and body.lost_s == 0.0


def test_a_goal_moves_one_joint(body: LiveBody, clock: Clock) -> None:
    clock.now += 0.5
    body.read()
    body.write_goal(3, 0.2, 0.2)
    for _ in range(50):
        clock.now += 0.02
        state = body.read()
    assert state.joint_position[3] == pytest.approx(0.2, abs=0.05)
    assert np.abs(np.delete(state.joint_position, 3)[::3]).max() < 0.1


def test_without_torque_the_robot_lies_down(body: LiveBody, clock: Clock) -> None:
    clock.now += 1.0
    standing = (body.read(), body.pose()[1][2])[1]
    for i in range(18):
        body.set_torque(i, False)
    clock.now += 1.0
    state = body.read()
    assert body.pose()[1][2] < standing - 0.02 and not state.load.any()


def test_goals_that_are_written_one_by_one_are_lost_or_taken_as_one_packet(clock: Clock) -> None:
    body, taken = LiveBody(Specimen.of(3, "lost_commands"), clock=clock), []
    for k in range(12):
        goal = 0.02 * (1 + k % 2)
        for i in range(18):
            body.write_goal(i, goal, 0.1)
        clock.now += 0.04
        body.read()
        goals = body._physics.servos.goal
        assert np.ptp(goals) == 0.0
        taken.append(goals[0] == pytest.approx(goal, abs=1e-3))
    assert any(taken) and not all(taken)


def test_the_voltmeter_shows_a_battery_that_sags(clock: Clock) -> None:
    volts = {}
    for hidden in ("none", "battery_sag"):
        body = LiveBody(Specimen.of(3, hidden), clock=clock)
        for _ in range(100):
            clock.now += 0.02
            state = body.read()
        volts[hidden] = state.voltage
    assert volts["battery_sag"] < volts["none"] - 0.1


def test_a_machine_that_is_too_slow_makes_the_robot_slow_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock(look_s=0.01)  # every 4 ms of motion take 10 ms
    body = LiveBody(Specimen.of(3, "none"), clock=clock)
    begun = clock.now
    with caplog.at_level(logging.WARNING):
        times = [body.read().time_s for _ in range(60)]
    assert np.all(np.diff(times) >= 0)
    assert times[-1] < 0.6 * (clock.now - begun)
    assert times[-1] + body.lost_s == pytest.approx(clock.now - begun, abs=0.3)
    assert "too slow for the emulated robot" in caplog.text


def test_the_socket_places_the_robot_and_tells_its_pose(body: LiveBody, clock: Clock, tmp_path: Path) -> None:
    with ExperimenterServer(body, tmp_path / "s"):
        client = ExperimenterClient(tmp_path / "s")
        client.place(Scene(0.2, -0.1, (Box((0.4, 0.0, 0.03), (0.1, 0.5, 0.06), 0.3),)))
        clock.now += 1.0
        _, position, orientation = client.pose()
        client.close()
    assert not (tmp_path / "s").exists()
    assert np.allclose(position, body.pose()[1], atol=1e-6)
    assert orientation[1] == pytest.approx(0.1, abs=0.02) and orientation[2] == pytest.approx(-0.05, abs=0.02)


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        ("rubbish", "not JSON"),
        ("[1]", "one JSON object"),
        ('{"do": "dance"}', "'place' or 'pose'"),
        ('{"do": "place", "slope_roll": 0.9}', "slope_roll"),
        ('{"do": "place", "slope_roll": NaN}', "slope_roll"),
        ('{"do": "place", "slop": 0.1}', "slop"),
        ('{"do": "place", "blocks": [{"center": [0, 0, 0]}]}', "center and size"),
        ('{"do": "place", "blocks": [{"center": [0, 0, 0], "size": [0.1, 0, 0.1]}]}', "edges"),
    ],
)
def test_a_wrong_request_is_answered_in_one_line(body: LiveBody, request_: str, says: str) -> None:
    reply = answer(body, request_.encode())
    assert reply["ok"] is False and says in reply["error"] and "\n" not in json.dumps(reply)


def test_a_second_robot_on_the_same_socket_is_refused_and_a_dead_ones_is_replaced(
    body: LiveBody, tmp_path: Path
) -> None:
    path = tmp_path / "s"
    with ExperimenterServer(body, path), pytest.raises(EmulatedRobotError, match="another emulated robot"):
        ExperimenterServer(body, path)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with ExperimenterServer(body, path):
        client = ExperimenterClient(path)
        assert client.pose()[1].shape == (3,)
        client.close()


def test_a_file_in_the_sockets_place_is_kept(body: LiveBody, tmp_path: Path) -> None:
    (tmp_path / "s").write_text("precious")
    with pytest.raises(EmulatedRobotError, match="no socket"):
        ExperimenterServer(body, tmp_path / "s")
    assert (tmp_path / "s").read_text() == "precious"


def test_a_client_without_a_robot_says_where_it_looked(tmp_path: Path) -> None:
    with pytest.raises(EmulatedRobotError, match="no emulated robot answers"):
        ExperimenterClient(tmp_path / "nobody").pose()
