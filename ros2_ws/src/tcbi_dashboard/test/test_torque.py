"""What the page says of the torque, and the words of nodes in those of the page."""

import pytest

from tcbi_contract.safety import Mode
from tcbi_dashboard.torque import OLD_S, RELEASE, RELEASED, RESET, STANDING, STOPPED, Torque, ago, in_page_words, shown


def test_simulation_and_driver_tell_their_torque_and_others_tell_none():
    simulated = {"model": "hexapod-v0", "torque": "limp", "needs_reset": "true", "mode": "realtime"}
    assert Torque.of(simulated, "limp: emergency stop released") == RELEASED
    driven = {"mode": "emergency stop", "needs_reset": "true"}
    assert Torque.of(driven, "emergency stop; call emergency_stop/release, then reset_episode to arm") == STOPPED
    lost = Torque.of({"mode": "limp", "needs_reset": "true"}, "limp: link lost: unplugged; call reset_episode to arm")
    assert lost == Torque(Mode.LIMP, True, "link lost: unplugged")
    assert Torque.of({"mode": "active", "needs_reset": "false"}, "active") == STANDING
    assert Torque.of({"policy": "gait:steps"}, "resting") is None


@pytest.mark.parametrize("mode", ["limp", "emergency stop"])
def test_torque_that_no_servo_confirms_to_be_off_is_not_said_to_be_off(mode: str):
    values = {"mode": mode, "needs_reset": "true", "torque_unconfirmed": "any servo"}
    head = shown(Torque.of(values, "limp: no reading; torque not confirmed to be off by any servo"), 0.5, True).head
    assert "is off" not in head and "cut the power" in head


def test_a_stop_is_said_and_leads_to_its_release_and_then_to_the_reset():
    stopped = shown(STOPPED, 0.5, motion=True)
    assert stopped.head == "STOPPED: torque is off" and stopped.stopped and stopped.release and not stopped.reset
    assert RELEASE in stopped.then
    released = shown(RELEASED, 0.5, motion=True)
    assert released.reset and not released.stopped and not released.release and RESET in released.then
    standing = shown(STANDING, 0.5, motion=True)
    assert standing.head == "Torque is on" and not (standing.release or standing.reset)


@pytest.mark.parametrize("torque", [STOPPED, RELEASED])
def test_a_page_that_may_not_move_the_robot_offers_nothing_that_would(torque):
    said = shown(torque, 0.5, motion=False)
    assert not said.release and not said.reset and "--allow-motion" in said.then


def test_what_was_heard_long_ago_looks_old():
    assert not shown(STANDING, OLD_S, True).old
    said = shown(STANDING, 12.0, True)
    assert said.old and said.head == "Torque is on (not heard for 12 s)"
    assert shown(None, 0.0, True).old


@pytest.mark.parametrize(("seconds", "words"), [(0.4, "0 s"), (119, "119 s"), (180, "3 min"), (7200, "2 h")])
def test_spans_are_said_in_the_unit_that_fits(seconds, words):
    assert ago(seconds) == words


@pytest.mark.parametrize(
    "told",
    [
        "reset_episode failed: reset: the emergency stop stands; call emergency_stop/release first",
        "joint_commands: the emergency stop stands; call emergency_stop/release, then reset_episode",
        "limp: link lost; call reset_episode to arm",
        "released; the robot stays limp until reset_episode",
        "nobody offers collect_rollouts after 10 s; start the graph (./tcbi up), or let --robot start one",
    ],
)
def test_no_service_and_no_other_commands_option_is_named_on_the_page(told):
    said = in_page_words(told)
    assert not any(name in said for name in ("reset_episode", "emergency_stop", "--robot"))
