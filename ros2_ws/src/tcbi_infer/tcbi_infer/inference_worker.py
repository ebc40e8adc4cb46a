"""The inference node's other half: one job a process, so that simulations never hold up a callback.

Its events, as `worker_process` passes them on: `warning`, `progress`, `generation`, `posterior`, `model_error`,
`diagnosis`; `superseded` in place of a posterior where the newest version is no longer the one that was inferred from.

    python -m tcbi_infer.inference_worker < job.json
"""

import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer import posterior
from tcbi_infer.bags.reader import read_measurements
from tcbi_infer.compare import compare
from tcbi_infer.compare.history import common_floor
from tcbi_infer.compare.ladder import not_seen, seen_by
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose.adopt import remember
from tcbi_infer.errors import BagError, InferError
from tcbi_infer.tcbi.driver import Progress, infer
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import Result, prior_sds
from tcbi_infer.worker_process import Emit, serve
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.store import LATEST, ModelStore
from tcbi_sim.workers import Here, using

INFER, DIAGNOSE = "infer", "diagnose"
DRAWS = 200  # equally weighted particles that a message carries


@dataclasses.dataclass(frozen=True)
class Job:
    """What a worker is asked for."""

    kind: str  # INFER or DIAGNOSE
    store: str
    model: str  # version, or "latest"
    bags: tuple[str, ...]  # to fit
    held_out: tuple[str, ...] = ()  # to judge, never to fit
    reference: str = ""  # version that shift and error are measured from; empty for `model`
    method: str = "calibrated"
    particles: int = 50
    generations: int = 0  # 0 for the method's own number
    seed: int = 0
    threads: int = 0

    def to_json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> "Job":
        """The job of a line."""
        data = json.loads(text)
        return Job(**{**data, "bags": tuple(data["bags"]), "held_out": tuple(data["held_out"])})


def usable(bags: Sequence[str], emit: Emit, rig: str | None = None) -> list[Measurement]:
    """Rollouts of the bags that can be read, of one rig; of each other bag a warning: one must not stop the rest.

    What a reader had to say of a rollout is a warning too.

    Raises:
      BagError: there is none.
    """
    found: dict[str, Measurement] = {}
    faults: list[str] = []
    for bag in bags:
        try:
            for measurement in read_measurements([bag], rig or next((m.rig for m in found.values()), None)):
                found.setdefault(measurement.rollout_id, measurement)
        except (BagError, OSError) as e:
            faults.append(" ".join(str(e).split()))
    if bags and not found:
        raise BagError(f"none of {counted(len(bags), 'bag')} can be used; the last: {faults[-1]}")
    for fault in faults:
        emit("warning", message=f"left out: {fault}")
    for measurement in found.values():
        for note in measurement.notes:
            emit("warning", message=f"{measurement.rollout_id}: {note}")
    return list(found.values())


def _to_fit(job: Job, emit: Emit) -> list[Measurement]:
    """The rollouts of a job.

    Raises:
      BagError: it names no bag, or none that can be used.
    """
    if not job.bags:
        raise BagError(
            "there is no rollout to fit: no bag is named, and none was recorded yet; record some, or name bags"
        )
    return usable(job.bags, emit)


def run_inference(job: Job, emit: Emit) -> None:
    """Infer, save a model version, and judge it and its parent on the rollouts that were held out."""
    store = ModelStore(job.store)
    measurements = _to_fit(job, emit)
    model = store.load(job.model, measurements[0].rig)
    method = find_method(job.method)
    problem = Problem.of(
        model, measurements, statistics=method.statistics, loop=method.loop, policies=store.root, threads=job.threads,
        seed=job.seed,
    )  # fmt: skip

    told = 0  # generations

    def watch(progress: Progress) -> None:
        nonlocal told
        done = (progress.generation - 1 + progress.share) / progress.generations
        stage = progress.stage or f"generation {progress.generation}"
        emit("progress", stage=stage, share=done, remaining_s=progress.remaining_s)
        if progress.generation - 1 > told and progress.share < 1:  # the last one's is the posterior itself
            told = progress.generation - 1
            emit("generation", **running(problem, job.method, told, progress))

    result = infer(
        problem,
        job.method,
        seed=job.seed,
        folder=store.folder("runs"),
        watch=watch,
        particles=job.particles,
        **({"generations": job.generations} if job.generations else {}),
    )
    if job.model == LATEST and (newest := store.load(LATEST, model.rig).version) != model.version:
        result.forget_state()
        emit("superseded", model=newest)  # a child of the older version would hide what somebody has added since
        return
    saved = posterior.save(store, result)
    reference = _reference(job, store, model)
    emit("posterior", **summary(result, saved, moved(reference, result)))
    try:
        versions = reference, saved
        _judge(versions, _unseen(usable(job.held_out, emit, model.rig), versions, store, emit), emit)
    except InferError as e:  # no reason to lose the posterior
        emit("warning", message=f"no error is judged: {e}")


def _reference(job: Job, store: ModelStore, model: Model) -> Model:
    """What shift and error are measured from; a version of another rig says nothing of this one."""
    reference = store.load(job.reference, model.rig) if job.reference else model
    return reference if reference.rig == model.rig else model


def _unseen(
    held_out: list[Measurement], versions: tuple[Model, Model], store: ModelStore, emit: Emit
) -> list[Measurement]:
    """Those that neither version's line of fits has seen: a user may have fitted one to all bags of the folder."""
    models = store.history(versions[0].rig)
    seen = {r for version in versions for r in seen_by(version, models)}
    unseen = not_seen(held_out, seen)
    judged = {m.rollout_id for m in unseen}
    if known := [m.rollout_id for m in held_out if m.rollout_id not in judged]:
        said = f"{versions[0].version} or the version after it comes from a fit that has seen them"
        emit("warning", message=f"no error is judged on {', '.join(known)}: {said}")
    return unseen


def _judge(versions: tuple[Model, Model], held_out: list[Measurement], emit: Emit) -> None:
    """The errors of the version before and of that after, over one floor, on rollouts that were held out.

    Raises:
      CompareError: these cannot be replayed.
    """
    if not held_out:
        return
    floor = common_floor(versions[::-1], Replay.of(versions[0], held_out))
    for role, version in zip(("before", "after"), versions, strict=True):
        emit("model_error", role=role, **model_error(version, held_out, floor))


def moved(before: Model, result: Result) -> float:
    """Largest shift of a parameter's mean, in standard deviations of the model before, on the parameter's scale.

    Infinite where a parameter is new: the policy has never met the effect that it belongs to.
    """
    if set(result.model.names) - set(before.names):
        return float("inf")
    unit = before.to_unit(before.particles)
    mean = before.weights @ unit
    sd = np.sqrt(before.weights @ (unit - mean) ** 2)
    now = dict(zip(result.model.names, np.exp(result.log_weights) @ result.unit, strict=True))
    shift = np.abs(np.array([now.get(name, mean[i]) for i, name in enumerate(before.names)]) - mean)
    return float(np.max(shift / np.maximum(sd, 1e-6)))


def running(problem: Problem, method: str, generation: int, progress: Progress) -> dict[str, Any]:
    """What `tcbi_msgs/Posterior` holds of an inference at work: no particles, and nothing is said to be identified."""
    model, known = problem.model, None if problem.prior is None else problem.prior.draws()
    return {
        "rig": model.rig,
        "model": model.version,
        "task": problem.task,
        "method": method,
        "generation": generation,
        "parameter": list(model.names),
        "unit": [p.unit for p in model.parameters],
        "mean": progress.mean.tolist(),
        "variance": (progress.sd**2).tolist(),
        "prior_variance": [sd**2 for sd in prior_sds(model.parameters, known)],
        "identified": [False] * len(model.names),
        "particles": [],
        "weights": [],
        "effective_sample_size": progress.ess,
        "statistic": [],
        "divergence": [],
        "source_rollouts": list(problem.rollout_ids),
        "converged": False,
    }


def summary(result: Result, saved: Model, shift: float) -> dict[str, Any]:
    """What `tcbi_msgs/Posterior` holds, and how far the mean moved."""
    prior = [e.prior_sd**2 for e in result.estimates]
    return {
        "rig": saved.rig,
        "model": saved.version,
        "task": result.task,
        "method": result.method,
        "generation": len(result.generations),
        "parameter": list(saved.names),
        "unit": [p.unit for p in saved.parameters],
        "mean": [e.mean for e in result.estimates],
        "variance": [e.sd**2 for e in result.estimates],
        "prior_variance": prior,
        "identified": [e.identified for e in result.estimates],
        "particles": result.draws(DRAWS).ravel().tolist(),
        "weights": [1.0 / DRAWS] * DRAWS,
        "effective_sample_size": result.ess,
        "statistic": list(result.statistics),
        "divergence": [result.divergence[s] for s in result.statistics],
        "source_rollouts": list(result.rollouts),
        "converged": result.converged,
        "moved": min(shift, 1e9),
        "warnings": list(result.warnings),
    }


def model_error(model: Model, measurements: list[Measurement], floor: NoiseFloor) -> dict[str, Any]:
    """What `tcbi_msgs/ModelError` holds."""
    return compare(model, measurements, particles=0, floor=floor).to_json()


def run_diagnosis(job: Job, emit: Emit) -> None:
    """Diagnose, with the stages as progress."""
    store = ModelStore(job.store)
    measurements = _to_fit(job, emit)
    model = store.load(job.model, measurements[0].rig)

    began = time.monotonic()

    def watch(stage: str, share: float) -> None:
        remaining_s = (time.monotonic() - began) * (1 - share) / share if share > 0 else None
        emit("progress", stage=stage, share=share, remaining_s=remaining_s)

    found = diagnose(model, measurements, progress=watch)
    remember(found, store.folder("runs"))
    emit("diagnosis", **found.to_json())


def main() -> int:
    """Run the job on standard input; 0 done, 1 failed."""

    def run(line: str, emit: Emit) -> None:
        job = Job.from_json(line)
        with using(Here(threads=job.threads)):
            {INFER: run_inference, DIAGNOSE: run_diagnosis}[job.kind](job, emit)

    return serve(run)


if __name__ == "__main__":
    sys.exit(main())
