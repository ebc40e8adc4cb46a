"""The inference node's worker and folder, without a graph: what is held out, what is said, what a model error is."""

import dataclasses
import errno
import io
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from tcbi_cases import bench_rollouts

from tcbi_contract.plain import plain
from tcbi_infer import inference_worker, rollout_folder
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.recovery import recover
from tcbi_infer.errors import BagError
from tcbi_infer.inference_worker import DIAGNOSE, INFER, Job, moved, run_inference, usable
from tcbi_infer.rollout_folder import QUIET_S, RolloutFolder
from tcbi_infer.worker_process import Worker, serve
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore
from tcbi_sim.workers import present

DEADLINE_S = 100.0


@pytest.fixture
def bags(tmp_path: Path) -> Path:
    folder = tmp_path / "bags"
    for i, measurement in enumerate(bench_rollouts(count=6, duration=2.0)[1]):
        bag = write_measurement(folder, measurement)
        os.utime(bag, (1000 + i, 1000 + i))
    return folder


def test_every_third_bag_is_held_out_for_good(bags: Path) -> None:
    folder = RolloutFolder(bags, holdout_every=3)
    assert folder.look() == 6 and folder.look() == 0
    assert [b.name for b in folder.held_out] == ["steps_0_2", "steps_0_5"]
    assert folder.rig == "servo_bench"
    assert len(folder.fitted) == 4 and not set(folder.fitted) & set(folder.held_out)


def test_repeats_of_a_scripted_motion_are_held_out_together(tmp_path: Path) -> None:
    for i, (policy, roll) in enumerate((g, r) for g in ("gait:steps", "balance") for r in (0.1, 0.2) for _ in range(2)):
        measured = bench_rollouts(count=1, duration=1.0)[1][0]
        scenario = dataclasses.replace(measured.scenario, slope_roll=roll)
        own = dataclasses.replace(measured, rollout_id=f"r{i}", policy_id=policy, scenario=scenario)
        os.utime(write_measurement(tmp_path, own), (1000 + i, 1000 + i))
    folder = RolloutFolder(tmp_path, holdout_every=2)
    folder.look()
    assert [b.name for b in folder.held_out] == ["r2", "r3", "r5", "r7"]  # a policy never moves the same way again


def test_a_folder_without_bags_is_waited_for(tmp_path: Path) -> None:
    assert RolloutFolder(tmp_path / "later", 5).look() == 0
    (tmp_path / "empty").mkdir()
    assert RolloutFolder(tmp_path / "empty", 5).look() == 0


def test_rollouts_of_another_source_than_the_newest_ones_are_left_out(bags: Path) -> None:
    folder, measured = RolloutFolder(bags, holdout_every=2), bench_rollouts(count=2, duration=2.0)[1]
    folder.look()
    simulated, source = folder.bags, folder.source
    assert len(simulated) == 6 and not folder.left_out
    for i, measurement in enumerate(measured):
        own = dataclasses.replace(measurement, rollout_id=f"robot_{i}", source="driver")
        os.utime(write_measurement(bags, own), (2000 + i, 2000 + i))
    (bags / "torn.mcap").write_bytes(b"no bag at all")
    aged(bags / "torn.mcap")
    folder.look()
    assert [b.name for b in folder.bags] == ["robot_0", "robot_1", "torn.mcap"]
    assert [b.name for b in folder.held_out] == ["robot_1"]
    assert folder.source == "driver" and folder.left_out == dict.fromkeys(simulated, source)
    assert RolloutFolder(bags, 0).look() == 9, "however many sources there are, all bags were looked at"


def aged(bag: Path, by_s: float = 2 * QUIET_S) -> Path:
    """A bag that nobody has written to for so long."""
    then = time.time() - by_s
    for path in (*bag.glob("*"), bag):
        os.utime(path, (then, then))
    return bag


def cut_off(bag: Path) -> Path:
    """What a full disk leaves: no metadata, no index, the end missing."""
    (bag / "metadata.yaml").unlink()
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    return bag


def test_a_bag_without_metadata_is_taken_once_nobody_writes_to_it(bags: Path) -> None:
    torn = cut_off(bags / "steps_0_3")
    folder = RolloutFolder(bags, 0)
    assert folder.look() == 5
    aged(torn)
    assert folder.look() == 1 and folder.bags[-1] == torn
    recover(torn)
    assert folder.look() == 0, "its original is no rollout of its own"
    (bags / "steps_0_4").rename(bags / "steps_9.recording")
    aged(cut_off(bags / "steps_9.recording"))
    assert RolloutFolder(bags, 0).look() == 5


def test_a_bare_file_among_the_bags_is_one_of_them(bags: Path) -> None:
    (bags / "steps_0_3" / "steps_0_3_0.mcap").rename(bags / "lab.mcap")
    aged(bags / "lab.mcap")
    folder = RolloutFolder(bags, 0)
    assert folder.look() == 6 and bags / "lab.mcap" in folder.bags


def test_a_repair_at_work_is_no_rollout(bags: Path) -> None:
    (bags / "steps_0_3").rename(bags / ".steps_0_3.recovered")
    assert RolloutFolder(bags, 0).look() == 5


def test_a_bag_that_vanishes_while_it_is_looked_at_is_passed_over(bags: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, found = RolloutFolder(bags, 0), rollout_folder.bags_in(bags)
    monkeypatch.setattr(rollout_folder, "bags_in", lambda _: found)
    shutil.rmtree(bags / "steps_0_3")
    assert folder.look() == 5


def job(bags: Path, tmp_path: Path, **changes: object) -> Job:
    fit, judge = sorted(map(str, bags.iterdir()))[:4], sorted(map(str, bags.iterdir()))[4:]
    values = {"kind": INFER, "model": "servo_bench-v0", "bags": tuple(fit), "held_out": tuple(judge)}
    values |= {"particles": 20, "generations": 2}
    return Job(store=str(tmp_path / "store"), **(values | changes))  # type: ignore[arg-type]


def test_a_job_survives_the_way_to_the_worker(bags: Path, tmp_path: Path) -> None:
    asked = job(bags, tmp_path)
    assert Job.from_json(asked.to_json()) == asked


def test_an_inference_judges_before_and_after_on_rollouts_that_it_did_not_fit(bags: Path, tmp_path: Path) -> None:
    events: list[tuple[str, dict]] = []
    run_inference(job(bags, tmp_path), lambda event, **content: events.append((event, content)))
    kinds = [kind for kind, _ in events if kind != "progress"]
    assert kinds == ["generation", "posterior", "model_error", "model_error"]
    found = next(content for kind, content in events if kind == "posterior")
    before, after = (content for kind, content in events if kind == "model_error")
    assert (before["model"], after["model"]) == ("servo_bench-v0", "servo_bench-v1")
    assert not set(after["rollouts"]) & set(found["source_rollouts"])
    assert np.isfinite(found["moved"]) and json.loads(json.dumps(plain(found)))
    assert ModelStore(tmp_path / "store").load("servo_bench-v1").evidence["inference"]["method"] == "calibrated"


def test_a_version_that_was_made_meanwhile_is_not_hidden_by_a_child_of_the_one_before(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, really = ModelStore(tmp_path / "store"), inference_worker.infer

    def meanwhile(*args: Any, **settings: Any) -> Any:
        result = really(*args, **settings)
        store.save(base_model("servo_bench").with_effect("command_latency"))
        return result

    monkeypatch.setattr(inference_worker, "infer", meanwhile)
    events: list[tuple[str, dict]] = []
    run_inference(job(bags, tmp_path, model="latest", generations=1), lambda event, **c: events.append((event, c)))
    assert events[-1] == ("superseded", {"model": "servo_bench-v1"})
    assert store.load("latest", "servo_bench").effects == ("command_latency",)
    assert not list(store.folder("runs").glob("*/state.npz")), "nobody goes on from it"


def test_a_reference_of_another_rig_is_passed_over_for_the_model_itself(bags: Path, tmp_path: Path) -> None:
    events: list[tuple[str, dict]] = []
    asked = job(bags, tmp_path, model="latest", reference="hexapod-v0", generations=1)
    run_inference(asked, lambda event, **content: events.append((event, content)))
    errors = [content["model"] for kind, content in events if kind == "model_error"]
    assert errors == ["servo_bench-v0", "servo_bench-v1"]
    assert np.isfinite(next(content["moved"] for kind, content in events if kind == "posterior"))


def test_rollouts_to_judge_on_that_cannot_be_replayed_cost_no_posterior(bags: Path, tmp_path: Path) -> None:
    whole = bench_rollouts(count=1, duration=2.0)[1][0]
    idle = dataclasses.replace(whole.commands, time=np.empty(0), target=np.empty((0, 1)))
    silent = write_measurement(tmp_path / "others", dataclasses.replace(whole, rollout_id="idle", commands=idle))
    events: list[tuple[str, dict]] = []
    asked = job(bags, tmp_path, held_out=(str(silent),), generations=1)
    run_inference(asked, lambda event, **content: events.append((event, content)))
    told = [content["message"] for kind, content in events if kind == "warning"]
    assert any(m.startswith("no error is judged") and "joint_commands" in m for m in told), told
    assert "posterior" in [kind for kind, _ in events]


def test_no_error_is_judged_on_rollouts_that_the_versions_fits_have_seen(bags: Path, tmp_path: Path) -> None:
    store, base = ModelStore(tmp_path / "store"), base_model("servo_bench")
    everything = [f"steps_0_{i}" for i in range(6)]
    given = base.with_particles(base.particles, base.log_weights, kind="diagnosis", rollouts=everything)
    events: list[tuple[str, dict]] = []
    emit = lambda event, **content: events.append((event, content))  # noqa: E731
    run_inference(job(bags, tmp_path, model=store.save(given).version, generations=1), emit)
    told = [content["message"] for kind, content in events if kind == "warning"]
    assert any("no error is judged on steps_0_4, steps_0_5" in m for m in told), told
    assert "posterior" in [kind for kind, _ in events] and "model_error" not in [kind for kind, _ in events]


def test_a_job_uses_as_many_threads_as_it_is_given(bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []

    def diagnosis(job: Job, emit: object) -> None:
        threads.append(present().threads)

    monkeypatch.setattr(inference_worker, "run_diagnosis", diagnosis)
    asked = job(bags, tmp_path, kind=DIAGNOSE, threads=1)
    monkeypatch.setattr(sys, "stdin", io.StringIO(asked.to_json() + "\n"))
    assert inference_worker.main() == 0
    assert threads == [1]


def test_after_each_generation_but_the_last_the_posterior_so_far_is_told_as_such(bags: Path, tmp_path: Path) -> None:
    from tcbi_infer.messages import posterior_message

    events: list[tuple[str, dict]] = []
    run_inference(job(bags, tmp_path, generations=3, held_out=()), lambda event, **c: events.append((event, c)))
    told = [content for kind, content in events if kind == "generation"]
    (final,) = (content for kind, content in events if kind == "posterior")
    assert [content["generation"] for content in told] == [1, 2]
    (file,) = (tmp_path / "store" / "runs").glob("*/generations.json")
    for content, entry in zip(told, json.loads(file.read_text()), strict=False):
        assert content["mean"] == entry["mean"] and content["effective_sample_size"] == entry["ess"]
        assert content["variance"] == pytest.approx(entry["variance"])
        assert (content["model"], content["prior_variance"]) == ("servo_bench-v0", final["prior_variance"])
        message = posterior_message(content, Time(sec=3))
        assert not message.converged and len(message.particles) == 0 and not any(message.identified)


def test_a_new_parameter_counts_as_an_unlimited_move() -> None:
    class Found:
        model = base_model("servo_bench").with_effect("command_latency")

    assert moved(base_model("servo_bench"), Found()) == float("inf")  # type: ignore[arg-type]


def test_a_bag_that_cannot_be_used_is_left_out_with_a_warning(bags: Path, tmp_path: Path) -> None:
    asked = job(bags, tmp_path)
    (bags / "torn.mcap").write_bytes(b"no bag at all")
    events: list[tuple[str, dict]] = []
    emit = lambda event, **content: events.append((event, content))  # noqa: E731
    run_inference(dataclasses.replace(asked, bags=(str(bags / "torn.mcap"), *asked.bags)), emit)
    warnings = [content["message"] for kind, content in events if kind == "warning"]
    assert len(warnings) == 1 and "torn.mcap" in warnings[0]
    (found,) = (content for kind, content in events if kind == "posterior")
    assert len(found["source_rollouts"]) == 4
    with pytest.raises(BagError, match=r"none of 1 bag can be used; the last: .*torn"):
        run_inference(dataclasses.replace(asked, bags=(str(bags / "torn.mcap"),)), emit)


def test_what_the_reader_had_to_say_of_a_used_bag_is_a_warning(bags: Path) -> None:
    cut_off(bags / "steps_0_3")
    warnings: list[str] = []
    used = usable(sorted(map(str, bags.iterdir())), lambda event, message: warnings.append(message))
    assert len(used) == 6
    (warning,) = warnings
    assert warning.startswith("steps_0_3: ") and "is damaged" in warning


def test_recordings_of_another_rig_are_refused(bags: Path, tmp_path: Path) -> None:
    heard: list[str] = []
    usable(sorted(map(str, bags.iterdir())), lambda event, **content: heard.append(event), rig="servo_bench")
    with pytest.raises(BagError, match="none of 6 bags can be used"):
        usable(sorted(map(str, bags.iterdir())), lambda event, **content: heard.append(event), rig="double_pendulum")
    assert not heard


def test_a_full_disk_fails_the_job_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def full(_: str, __: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "store/runs")

    monkeypatch.setattr(sys, "stdin", io.StringIO("{}\n"))
    assert serve(full) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["event"] == "failed" and "No space left" in line


def test_a_fault_of_the_input_arrives_as_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("random", "secrets", "signal"):  # what lies in the user's folder is none of the worker's libraries
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    worker = Worker(Job(INFER, str(tmp_path), "latest", (str(tmp_path / "nowhere"),)))
    events: list[dict] = []
    deadline = time.monotonic() + DEADLINE_S
    while not events and time.monotonic() < deadline:
        events += worker.events()
        time.sleep(0.05)
    worker.stop()
    assert events[0]["event"] == "failed" and "nowhere" in events[0]["message"] and "\n" not in events[0]["message"]


@pytest.mark.parametrize("kind", [INFER, DIAGNOSE])
def test_a_job_without_bags_fails_in_one_line(kind: str, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    asked = Job(kind, str(tmp_path), "latest", bags=())
    monkeypatch.setattr(sys, "stdin", io.StringIO(asked.to_json() + "\n"))
    assert inference_worker.main() == 1
    told = json.loads(capsys.readouterr().out)
    assert told["event"] == "failed" and told["message"].startswith("there is no rollout to fit")


STRAY = """
import os
from tcbi_infer.worker_process import serve

def run(line, emit):
    for text in (b"a library speaks", b"[1, 2]", b'"text"', b"{}", b"\\xff", b""):
        os.write(1, text + b"\\n")
    emit("progress", share=0.5)

raise SystemExit(serve(run))
"""


def test_what_a_library_writes_among_the_events_is_passed_over(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "stray_worker.py").write_text(STRAY)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    worker = Worker(job(bags, tmp_path), "stray_worker")
    events: list[dict] = []
    deadline = time.monotonic() + DEADLINE_S
    while len(events) < 2 and time.monotonic() < deadline:
        events += worker.events()
        time.sleep(0.05)
    worker.stop()
    assert events == [{"event": "progress", "share": 0.5}, {"event": "done"}]


def test_a_worker_that_dies_is_a_failure_and_not_a_silence(bags: Path, tmp_path: Path) -> None:
    worker = Worker(job(bags, tmp_path, generations=100))
    worker.stop()
    events = list(worker.events())
    assert events and events[-1]["event"] == "failed"


def test_the_document_lists_the_nodes_parameters_as_they_are() -> None:
    from tcbi_contract.parameters import parameter_table
    from tcbi_infer.inference_node import InferenceParameters

    rows = [f"| `{n}` | `{d}` | {a} | {t} |" for n, d, a, t in parameter_table(InferenceParameters)]
    document = Path(__file__).resolve().parents[4] / "docs" / "tcbi.md"
    assert "\n".join(rows) in document.read_text(), "\n".join(rows)
