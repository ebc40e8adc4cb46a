"""The answers to a goal get lost on the way: it is asked for again, and never sent twice."""

import time
from types import SimpleNamespace

import pytest
from action_msgs.msg import GoalStatus
from rclpy.task import Future

from tcbi_contract.goals import UNKNOWN_TIMES, SentGoal
from tcbi_infer import collect_client
from tcbi_infer.collection import Request
from tcbi_infer.errors import RecordingError
from tcbi_msgs.action import CollectRollouts

pytestmark = pytest.mark.graph


class DeafClient:
    """An action client's inside whose server loses answers: to the goal, and to the first question for its end."""

    def __init__(self, *ends) -> None:
        self.asked, self.ids, self._ends = 0, [], list(ends)

    def send_goal_async(self, *_, goal_uuid, **__) -> Future:
        self.ids.append(bytes(goal_uuid.uuid))
        return Future()

    def _get_result_async(self, _) -> Future:
        self.asked += 1
        future = Future()
        if self.asked > 1:
            future.set_result(self._ends.pop(0) if len(self._ends) > 1 else self._ends[0])
        return future


def test_the_end_of_a_goal_is_asked_for_again_where_answers_are_lost():
    client = DeafClient(SimpleNamespace(status=GoalStatus.STATUS_SUCCEEDED, result="the end"))
    sent = SentGoal(client, CollectRollouts, CollectRollouts.Goal())
    assert not (sent.taken or sent.refused or sent.wants_asking(0.2))
    time.sleep(0.25)
    assert sent.wants_asking(0.2)
    sent.ask()
    assert not (sent.taken or sent.refused or sent.wants_asking(0.2)) and sent.end is None
    sent.ask()
    assert sent.taken and sent.end.result == "the end"


UNKNOWN = SimpleNamespace(status=GoalStatus.STATUS_UNKNOWN, result=CollectRollouts.Result())


def test_a_goal_that_its_server_does_not_know_yet_is_sent_again_under_its_id():
    client = DeafClient(UNKNOWN, UNKNOWN, SimpleNamespace(status=GoalStatus.STATUS_SUCCEEDED))
    sent = SentGoal(client, CollectRollouts, None)
    for _ in range(3):
        sent.ask()
        assert not (sent.taken or sent.refused) and sent.end is None
    assert len(client.ids) == 2 and len(set(client.ids)) == 1
    sent.ask()
    assert sent.taken and not sent.refused and sent.end.status == GoalStatus.STATUS_SUCCEEDED


def test_a_goal_that_is_taken_after_its_server_did_not_know_it_is_under_way():
    client = DeafClient(UNKNOWN)
    sent = SentGoal(client, CollectRollouts, None)
    sent.ask()
    sent.ask()
    sent._hear(None)  # feedback
    assert sent.taken and not sent.refused and sent.end is None
    sent.ask()
    assert sent.end is UNKNOWN, "it has forgotten it since"


def test_a_goal_that_its_server_never_gets_to_know_was_not_taken():
    sent = SentGoal(DeafClient(UNKNOWN), CollectRollouts, None)
    for _ in range(1 + UNKNOWN_TIMES):
        assert not sent.refused
        sent.ask()
    assert sent.refused and not sent.taken


def test_a_recorder_that_was_restarted_meanwhile_is_named(domain, monkeypatch):
    monkeypatch.setattr(collect_client, "ASK_AGAIN_S", 0.1)
    with collect_client.CollectClient(domain) as client:
        deaf = DeafClient(UNKNOWN)
        monkeypatch.setattr(client._client, "server_is_ready", lambda: True)
        monkeypatch.setattr(client._client, "send_goal_async", deaf.send_goal_async)
        monkeypatch.setattr(client._client, "_get_result_async", deaf._get_result_async)
        with pytest.raises(RecordingError, match=r"restarted meanwhile .* finished rollouts lie in its folder"):
            client.collect(Request("balance", 1))
