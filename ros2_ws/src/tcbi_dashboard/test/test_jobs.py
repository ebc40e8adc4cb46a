"""One job at a time, watched and cancelled."""

import json
import threading
from typing import Any

import numpy as np
import pytest

from tcbi_dashboard.errors import DashboardError
from tcbi_dashboard.jobs import TITLES, Slot
from tcbi_dashboard.task import ADD, COLLECT, COMPARE, DIAGNOSE, MODULE, Task
from tcbi_dashboard.work import RUNS, Telling, run_add
from tcbi_infer.errors import InferError
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore


class Told:
    """A worker that says what the test tells it."""

    def __init__(self, job: Task, module: str) -> None:
        self.job, self.module = job, module
        self.said: list[dict[str, Any]] = []
        self.stopped = threading.Event()

    def events(self):
        while self.said:
            yield self.said.pop(0)

    def stop(self) -> None:
        self.stopped.set()


@pytest.fixture
def slot():
    """A slot, and the workers that it made."""
    made: list[Told] = []

    def make(job, module):
        made.append(Told(job, module))
        return made[-1]

    return Slot(make), made


def test_a_task_survives_its_line():
    task = Task(DIAGNOSE, "/store", "hexapod-v1", ("a", "b"), {"quick": True})
    assert Task.from_json(task.to_json()) == task


def test_every_kind_of_task_can_be_run_and_has_a_title():
    assert set(RUNS) == set(TITLES)


def test_progress_and_result_are_taken_in(slot):
    slot, made = slot
    job = slot.start(Task(COMPARE, "/store"))
    assert made[0].module == MODULE and slot.busy
    made[0].said = [
        {"event": "progress", "stage": "replaying", "share": 0.5, "remaining_s": 3.0},
        {"event": "result", "folder": "x"},
    ]
    slot.poll()
    assert (job.stage, job.share, job.remaining_s, job.result) == ("replaying", 0.5, 3.0, {"folder": "x"})
    made[0].said = [{"event": "done"}]
    slot.poll()
    assert job.ended and not job.failed and not slot.busy
    assert made[0].stopped.wait(5.0)


def test_a_second_job_is_refused_while_one_runs(slot):
    slot, _ = slot
    slot.start(Task(COMPARE, "/store"))
    with pytest.raises(DashboardError, match="Comparing is still going on"):
        slot.start(Task(DIAGNOSE, "/store"))


def test_a_cancelled_job_ends_at_once_and_makes_room(slot):
    slot, made = slot
    job = slot.start(Task(COMPARE, "/store"))
    slot.cancel()
    assert job.cancelled and job.ended and not slot.busy
    assert made[0].stopped.wait(5.0)
    slot.cancel()
    slot.start(Task(DIAGNOSE, "/store"))
    assert slot.busy


def test_closing_waits_until_the_process_is_gone():
    slot = Slot()
    slot.start(Task(COMPARE, "/nowhere"))
    process = slot._worker._process  # type: ignore[union-attr]
    slot.close()
    assert process.poll() is not None and not slot.busy


def test_a_failure_is_kept_in_its_own_words(slot):
    slot, made = slot
    job = slot.start(Task(COMPARE, "/store"))
    made[0].said = [{"event": "failed", "message": "the disk is full"}]
    slot.poll()
    assert job.failed == "the disk is full" and job.ended and not slot.busy


def test_how_a_job_ended_is_shown_until_it_is_dismissed_or_the_next_one_starts(slot):
    slot, made = slot
    job = slot.start(Task(COLLECT, "/store"))
    slot.dismiss()
    assert job.line == "Recording: starting; running for 0 s"  # what runs cannot be dismissed
    made[0].said = [{"event": "progress", "stage": "replaying", "share": 0.5, "remaining_s": 3.0}]
    slot.poll()
    assert job.line == "Recording: replaying; about 3 s left in all"
    made[0].said = [{"event": "failed", "message": "reset_episode failed: reset: no feedback"}]
    slot.poll()
    assert job.line == "Recording failed: the robot could not be reset: no feedback"
    before = job.state
    slot.dismiss()
    assert job.line == "" and job.state != before
    assert slot.start(Task(COMPARE, "/store")).line


def test_a_collection_tells_which_rollout_it_is_at_and_how_much_of_all_is_done():
    said: list[tuple[str, float]] = []
    telling = Telling(lambda stage, share: said.append((stage, share)), before=1, total=4)
    for done, left_s in ((0, 10.0), (0, 5.0), (0, 0.0), (1, 10.0)):
        telling(done, "walk", left_s)
    assert said[0] == ("walk, rollout 2 of 4, which lasts 10 s more", 0.25)
    assert said[1] == ("walk, rollout 2 of 4, which lasts 5 s more", 0.375)
    assert said[2] == ("walk, rollout 2 of 4, being saved", 0.5)
    assert said[3] == ("walk, rollout 3 of 4, which lasts 10 s more", 0.5)


def test_a_real_worker_says_why_it_failed(tmp_path):
    slot = Slot()
    job = slot.start(Task(COMPARE, str(tmp_path), bags=(str(tmp_path / "nowhere"),)))
    deadline = threading.Event()
    for _ in range(600):
        slot.poll()
        if job.ended or deadline.wait(0.1):
            break
    assert "there is no such bag" in job.failed


def test_a_size_on_which_the_motions_disagree_is_not_added(tmp_path):
    store, model = ModelStore(tmp_path), base_model("servo_bench")
    child = model.with_effect("backlash")
    spread = (1e-4 * np.eye(len(child.parameters))).tolist()
    fitted = {
        "use": "backlash", "refined": True, "accepted": True, "error_after": 1.2, "values": child.mean().tolist(),
        "spread": spread, "parameters": [{"name": "backlash.gap"}],
    }  # fmt: skip
    kinds = [{"kind": kind, "value": gap} for kind, gap in (("sines", 0.02), ("steps", 0.06))]
    told = {"name": "backlash.gap", "agrees": False, "statement": "The motions disagree on it.", "kinds": kinds}
    found = {
        "model": model.version, "verdict": "effect", "statement": "", "ranking": [fitted], "rollouts": [], "sealed": [],
        "errors": {}, "floor_from_replicates": True, "agreement": {"backlash": [told]},
    }  # fmt: skip
    file = tmp_path / "diagnosis.json"
    file.write_text(json.dumps(found))
    task = Task(ADD, str(tmp_path), model.version, (), {"use": "backlash", "diagnosis": str(file)})
    with pytest.raises(InferError, match="The motions disagree on it"):
        run_add(task, lambda *_, **__: None)
    assert [v.version for v in store.history("servo_bench")] == [model.version]
