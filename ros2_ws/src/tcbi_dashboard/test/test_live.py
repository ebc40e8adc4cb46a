"""What the page makes of what it hears, and of silence."""

import time

import pytest

from tcbi_dashboard.live import Live, Said, Topic
from tcbi_dashboard.torque import STANDING, STOPPED
from tcbi_dashboard.views.live import diagnosis_line
from tcbi_dashboard.views.record import landed


@pytest.fixture
def live():
    """A graph with a recorder and a robot."""
    seen = Live()
    seen.topics["joint_states"] = Topic("joint_states", 50.0)
    seen.nodes = ("/policy_node", "/recorder_node")
    return seen


def test_the_torque_is_what_the_newest_diagnostics_say(live):
    live.diagnosed("driver_node: safety", 0, "active", {"mode": "active", "needs_reset": "false"})
    assert live.torque == STANDING
    live.diagnosed("policy_node", 0, "resting", {"policy": "gait:steps"})
    assert live.torque == STANDING
    live.note_torque(STOPPED)
    assert live.shown_torque(motion=True).stopped


def test_silence_is_said_with_its_length_and_is_no_alarm(live):
    live.diagnosed("policy_node", 0, "resting", {})
    assert live.last_word("policy_node") == ""
    live.diagnostics["policy_node"] = Said(0, "resting", time.monotonic() - 12.0)
    assert live.last_word("policy_node") == "policy_node not heard for 12 s"
    assert live.last_word("recorder_node") == ""  # which has never spoken
    old = diagnosis_line("policy_node", Said(2, "stopped", 0.0), 12.0)
    assert old == ("policy_node: not heard for 12 s (then: error, stopped)", "tcbi-old")
    assert diagnosis_line("policy_node", Said(2, "stopped", 0.0), 1.0) == ("policy_node: error, stopped", "tcbi-error")


def test_recording_says_at_once_what_is_missing(live):
    assert live.cannot_record() == ""
    live.note_torque(STOPPED)
    assert "Release the stop" in live.cannot_record()
    live.nodes = ("/policy_node",)
    assert "no recorder_node" in live.cannot_record()
    live.nodes = ()
    assert "./tcbi up --robot" in live.cannot_record()
    live.heard("joint_states")
    assert "no recorder_node" in live.cannot_record()


def test_where_a_recording_went_is_said(tmp_path):
    bag = tmp_path / "bags" / "walk"
    assert landed([], []) == "Nothing was recorded."
    assert "on another computer" in landed([bag], [])
    bag.mkdir(parents=True)
    assert landed([bag], []) == f"1 rollout recorded in {bag.parent}; it is on the Compare view."
    assert f"./tcbi dashboard {bag.parent}" in landed([bag, bag], [bag.parent])
