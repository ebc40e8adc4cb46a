"""What a store holds of earlier trainings, whichever program made it."""

import json

import pytest

from tcbi_dashboard.retrainings import KEPT, NOT_KEPT, UNFINISHED, policies, retrainings
from tcbi_policy.runs import installed

CURVE = [{"steps": 0, "mean_return": 457.0}, {"steps": 2560, "mean_return": 512.0}]
CARD = {"task": "balance", "model": "hexapod-v2", "parent": "balance-early@3c46", "curve": CURVE, "training": {}}
RUN = {"config": {"task": "balance", "budget_s": 120.0}, "model": "hexapod-v2", "rival": "balance-early"}
RUN |= {"contents": f"balance-early@3c46, own files 0, {installed()}"}


def write(path, content):
    """A file of the store."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


@pytest.fixture
def store(tmp_path):
    """One policy that was kept, one that was not, and one training that was cancelled."""
    better = {"rival": "balance-early@3c46", "before": 457.0, "after": 512.0, "statement": "better by 55 points"}
    kept = {**CARD, "created": "2026-01-02T00:00:00", "training": {"comparison": better}}
    write(tmp_path / "policies/balance-1.json", kept)
    (tmp_path / "policies/balance-1.safetensors").touch()
    write(tmp_path / "runs/retrain-balance-aaa/run.json", RUN)
    write(tmp_path / "runs/retrain-balance-aaa/policy.json", {**CARD, "created": "2026-01-01T00:00:00"})
    write(tmp_path / "runs/retrain-balance-aaa/outcome.json", {"statement": "no better: 3 points, 95 % -4 to 10"})
    write(tmp_path / "runs/retrain-balance-bbb/run.json", RUN)
    (tmp_path / "runs/retrain-balance-bbb/checkpoint.safetensors").touch()
    return tmp_path


def test_all_are_listed_with_what_came_of_them(store):
    found = retrainings(store)
    assert [r.ended for r in found] == [UNFINISHED, KEPT, NOT_KEPT]
    cancelled, kept, other = found
    assert (kept.name, kept.rival, kept.said) == ("balance-1", "balance-early", "better by 55 points")
    assert kept.curve == other.curve == ((0, 457.0), (2560, 512.0))
    assert other.said == "no better: 3 points, 95 % -4 to 10"
    assert "goes on where it stopped" in cancelled.said and "120 s" in cancelled.said


def test_a_training_that_goes_on_after_its_policy_was_refused_is_not_finished(store):
    (store / "runs/retrain-balance-aaa/checkpoint.safetensors").touch()
    assert [r.ended for r in retrainings(store)] == [UNFINISHED, UNFINISHED, KEPT]


def test_a_training_begun_with_other_code_does_not_go_on(store):
    other = {**RUN, "contents": "balance-early@3c46, own files 0, code 0, python 3"}
    write(store / "runs/retrain-balance-bbb/run.json", other)
    (cancelled, *_) = retrainings(store)
    assert cancelled.ended == UNFINISHED and "other code" in cancelled.said and "begins afresh" in cancelled.said


def test_what_an_older_version_did_not_write_down_is_not_made_up(store):
    (store / "runs/retrain-balance-aaa/outcome.json").unlink()
    assert "not written down" in retrainings(store)[-1].said


def test_policies_to_beat_are_those_of_the_task_whatever_their_name(store):
    write(store / "policies/steady.json", {**CARD, "created": "2026-01-03T00:00:00"})
    (store / "policies/steady.safetensors").touch()
    write(store / "policies/walker.json", {**CARD, "task": "forward"})
    (store / "policies/walker.safetensors").touch()
    found = policies(store, "balance")
    assert "balance" in found and found[-2:] == ["balance-1", "steady"] and "walker" not in found


def test_the_policy_offered_first_is_the_one_that_the_command_takes(store):
    assert policies(store, "balance")[-1] == "balance-1"
    assert policies(store / "empty", "balance")[-1] == "balance"


def test_a_damaged_card_hides_no_other(store):
    (store / "policies/torn.json").write_text("{")
    (store / "runs/retrain-balance-ccc").mkdir()
    assert len(retrainings(store)) == 3
