"""The page's long work, one job a process: the page never waits, and a cancelled job leaves nothing half done.

Its events, as `tcbi_infer.worker_process` passes them on: `progress`, then `result`.

    python -m tcbi_dashboard.work < job.json
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tcbi_dashboard.task import ADD, COLLECT, COMPARE, DIAGNOSE, HISTORY, INFER, REMOVE, RETRAIN, Task
from tcbi_infer.worker_process import Emit, serve
from tcbi_sim.store import ModelStore

READY_S = 10.0  # for the recorder of the graph to be there


class Watch:
    """Progress with the time that is left, if the share done tells it."""

    def __init__(self, emit: Emit) -> None:
        self._emit, self._began = emit, time.monotonic()

    def __call__(self, stage: str, share: float | None = None) -> None:
        spent = time.monotonic() - self._began
        left = spent * (1 - share) / share if share and share > 0.03 else None
        self._emit("progress", stage=stage, share=share, remaining_s=left)


def read(bags: Sequence[str], watch: Watch) -> list[Any]:
    """The measurements of bags, one after the other so that progress can be told."""
    from tcbi_infer.bags.reader import read_measurements

    found: list[Any] = []
    for i, bag in enumerate(bags):
        watch(f"reading rollout {i + 1} of {len(bags)}", None)
        found += read_measurements([Path(bag)])
    return found


def run_compare(task: Task, emit: Emit) -> None:
    """Compare, write the report that the command line writes, and the pieces that the page shows."""
    from tcbi_dashboard import pack
    from tcbi_infer.compare import compare
    from tcbi_infer.compare.ladder import ladder, lineage
    from tcbi_infer.report import Report, add_comparison, file_name

    watch, store = Watch(emit), ModelStore(task.store)
    measurements = read(task.bags, watch)
    model = store.load(task.model, measurements[0].rig)
    watch(f"replaying {len(measurements)} rollouts in {model.version}")
    comparison = compare(model, measurements)
    also = None
    if other := task.options.get("also"):
        watch(f"replaying them in {other}")
        also = compare(store.load(other, model.rig), measurements, particles=0, floor=comparison.floor)
    watch("replaying them in the versions before")
    rungs = ladder(comparison, lineage(model, store.history(model.rig)), measurements)
    watch("writing what the page shows")
    report = Report("Model against measurement", f"Model {model.version}, {len(comparison.rollouts)} rollouts.")
    add_comparison(report, comparison, also, rungs)
    written = report.write(store.folder("reports") / file_name("compare", model.version, comparison.rollouts))
    emit("result", folder=str(pack.write(store.folder("runs"), model, comparison, also, rungs, written.name)))


def run_diagnose(task: Task, emit: Emit) -> None:
    """Diagnose, and remember it where the command line would."""
    from tcbi_infer.diagnose import diagnose
    from tcbi_infer.diagnose.adopt import remember
    from tcbi_infer.diagnose.settings import QUICK, Settings
    from tcbi_infer.report import Report, add_diagnosis

    watch, store = Watch(emit), ModelStore(task.store)
    measurements = read(task.bags, watch)
    model = store.load(task.model, measurements[0].rig)
    settings = QUICK if task.options.get("quick") else Settings()
    diagnosis = diagnose(model, measurements, settings=settings, progress=watch)
    saved = remember(diagnosis, store.folder("runs"))
    report = Report("What does the model lack?", f"Model {model.version}, {len(diagnosis.rollouts)} rollouts.")
    add_diagnosis(report, diagnosis)
    report.write(saved.with_suffix(".html"))
    emit("result", file=str(saved))


def run_add(task: Task, emit: Emit) -> None:
    """The next version with an effect in it, as a remembered diagnosis fitted it."""
    from tcbi_infer.diagnose.adopt import offered
    from tcbi_infer.diagnose.adopt import read as read_diagnosis
    from tcbi_infer.report import Report, add_version

    store, use = ModelStore(task.store), task.options["use"]
    parent = store.load(task.model)
    Watch(emit)(f"adding {use} to {parent.version}")
    saved = store.save(offered(parent, use, read_diagnosis(Path(task.options["diagnosis"]))))
    report = Report(f"{saved.version}: {parent.version} with {use}", "A new model version.")
    add_version(report, parent, saved)
    report.write(store.folder("reports") / f"add-{saved.version}.html")
    emit("result", model=saved.version)


def run_remove(task: Task, emit: Emit) -> None:
    """The next version without one of its effects."""
    from tcbi_infer.compare.versions import compare_versions, marginal_evidence
    from tcbi_infer.report import Report, add_difference

    store, use = ModelStore(task.store), task.options["use"]
    parent = store.load(task.model)
    Watch(emit)(f"taking {use} out of {parent.version}")
    child = dataclasses.replace(parent.without_effect(use), evidence=marginal_evidence(parent, use))
    saved = store.save(child)
    report = Report(f"{saved.version}: {parent.version} without {use}", saved.evidence["statement"])
    add_difference(report, compare_versions(parent, saved))
    report.write(store.folder("reports") / f"remove-{saved.version}.html")
    emit("result", model=saved.version)


def run_history(task: Task, emit: Emit) -> None:
    """Every version's error, on the rollouts given that no fit has seen."""
    from tcbi_infer.compare.history import history, remember
    from tcbi_infer.compare.ladder import not_seen
    from tcbi_infer.errors import InferError
    from tcbi_infer.report import Report, add_history, file_name
    from tcbi_infer.seen import used_before

    watch, store = Watch(emit), ModelStore(task.store)
    measurements = read(task.bags, watch)
    rig = measurements[0].rig
    versions = store.history(rig)
    seen = {r for v in versions for r in used_before(v)}
    unseen = not_seen(measurements, seen)
    if not unseen:
        raise InferError(
            f"a fit has seen each of the {len(measurements)} rollouts chosen, so no version can be judged on them; "
            "record new ones, or choose others"
        )
    watch(f"replaying {len(unseen)} rollouts in {len(versions)} versions")
    lines = history(versions, unseen)
    nan = float("nan")
    rows = [
        (v.model, v.parent or "–", ", ".join(v.effects) or "none",
         nan if v.error_over_floor is None else v.error_over_floor)
        for v in lines
    ]  # fmt: skip
    left = len(measurements) - len(unseen)
    told = f"The error of each version on {len(unseen)} rollouts that no fit has seen."
    told += (
        f" {left} of the {len(measurements)} chosen do not count, since a fit has seen them, or repeats of them."
        * bool(left)
    )
    report = Report("Model versions", told)
    add_history(report, rows, lines[0].floor_from_replicates)
    report.write(store.folder("reports") / file_name("history", versions[-1].version, lines[0].rollouts))
    counted = {m.rollout_id for m in unseen}
    not_counted = [m.rollout_id for m in measurements if m.rollout_id not in counted]
    path = remember(lines, store.folder("runs"), rig, not_counted)
    emit("result", file=str(path))


def run_infer(task: Task, emit: Emit) -> None:
    """Infer and save the posterior as a new version."""
    from tcbi_infer import posterior
    from tcbi_infer.tcbi.driver import infer
    from tcbi_infer.tcbi.method import find_method
    from tcbi_infer.tcbi.problem import Problem

    watch, store = Watch(emit), ModelStore(task.store)
    measurements = read(task.bags, watch)
    model = store.load(task.model, measurements[0].rig)
    method = find_method("calibrated")
    problem = Problem.of(model, measurements, statistics=method.statistics, prior="model", policies=store.root)
    result = infer(
        problem,
        method.name,
        folder=store.folder("runs"),
        watch=lambda p: watch(f"generation {p.generation}", (p.generation - 1 + p.share) / p.generations),
    )
    saved = posterior.save(store, result)
    emit("result", model=saved.version, warnings=list(result.warnings))


def run_retrain(task: Task, emit: Emit) -> None:
    """Train a policy's successor; it is kept only if it is better with confidence."""
    from tcbi_policy.retraining import Job, plan, retrain

    watch = Watch(emit)
    job = Job(
        task.options["task"],
        task.options["policy"],
        model=task.model,
        store=Path(task.store),
        budget_s=task.options.get("budget_s", 0.0),
        threads=task.options.get("threads", 0),
    )
    watch(f"training against {job.current} on {plan(job).model}")

    def follow(event: dict[str, Any]) -> None:
        if event["event"] == "progress":
            watch("training", event["share"])
        elif event["event"] == "comparing":
            watch(f"comparing with {event['rival']} on {event['pairs']} held-out rollouts")
        elif event["event"] == "evaluation":
            emit("training", content=event)

    outcome = retrain(job, follow)
    emit("result", **dataclasses.asdict(outcome))


@dataclasses.dataclass
class Telling:
    """Progress of one of several collections in a row."""

    watch: Callable[[str, float], None]
    before: int
    total: int
    length_s: float = 0.0  # of a rollout, as far as it has been seen

    def __call__(self, done: int, name: str, left_s: float) -> None:
        self.length_s = max(self.length_s, left_s)
        part = 1 - left_s / self.length_s if self.length_s else 0.0
        state = f"which lasts {left_s:.0f} s more" if left_s >= 0.5 else "being saved"
        number = min(self.before + done + 1, self.total)
        self.watch(f"{name}, rollout {number} of {self.total}, {state}", (number - 1 + part) / self.total)


def run_collect(task: Task, emit: Emit) -> None:
    """Ask the recorder of the running graph for rollouts; to be cancelled is to have the present one aborted."""
    from tcbi_infer.collect_client import CollectClient
    from tcbi_infer.collection import Request, check
    from tcbi_infer.errors import RecordingError

    wish = task.options
    number, times = wish["number"], wish["times"]
    slopes = {axis: (wish[axis],) * number for axis in ("slope_roll", "slope_pitch") if wish.get(axis) is not None}
    request = Request(wish["task"], number, wish["seed"], wish["policy"], duration_s=wish["duration_s"], **slopes)
    check(request)
    watch, bags = Watch(emit), []
    watch("waiting for the recorder")
    with CollectClient(namespace=wish["namespace"]) as client:
        for again in range(times):  # the same request makes the same motions on the same slopes
            client.on_progress = Telling(watch, again * number, number * times)
            result, succeeded = client.collect(request, READY_S)
            bags += list(result.bags)
            emit("result", bags=bags, message=result.message)
            if not succeeded:
                raise RecordingError(f"{len(bags)} of {number * times} rollouts recorded: {result.message}")


RUNS: dict[str, Callable[[Task, Emit], None]] = {
    COMPARE: run_compare,
    DIAGNOSE: run_diagnose,
    HISTORY: run_history,
    ADD: run_add,
    REMOVE: run_remove,
    INFER: run_infer,
    RETRAIN: run_retrain,
    COLLECT: run_collect,
}


def main() -> int:
    """Run the task on standard input; 0 done, 1 failed."""

    def run(line: str, emit: Emit) -> None:
        task = Task.from_json(line)
        RUNS[task.kind](task, emit)

    return serve(run)


if __name__ == "__main__":
    sys.exit(main())
