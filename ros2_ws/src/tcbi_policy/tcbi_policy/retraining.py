"""Train a successor of a policy on a model version, and say with confidence whether it is better.

    outcome = retrain(Job("balance", model="hexapod-v2", current="balance", store=root), on_event, cancelled)
    if outcome.accepted: load outcome.reference into the policy node

The training runs in a subprocess in a folder of the store that belongs to the job: whoever dies, subprocess or caller,
the next call with the same job goes on from the last checkpoint. A successor is accepted only if its return is higher
with confidence, of which each further attempt takes more (attempts.py), on draws of the model that neither the training
nor the choice of the best policy has seen; accepted ones are kept in the store under the next free name (`balance-1`,
`balance-2`, ...). What a policy was trained to withstand beyond its model, noise on the observation and further
effects, its successor meets too, in the training and in the comparison.
"""

import contextlib
import dataclasses
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcbi_contract.errors import describe
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_policy.artefact import (
    GAIT_PREFIX,
    Actor,
    Policy,
    find_policy,
    load_policy,
    locked,
    name_of,
    newest_policy,
    policy_paths,
    save_policy,
)
from tcbi_policy.configuration import TrainingConfig, check_start, preset
from tcbi_policy.errors import PolicyError, PolicyNotFound, TrainingError
from tcbi_policy.evaluation import check_rig
from tcbi_policy.randomisation import randomised
from tcbi_policy.runs import Run, TrainingProcess, write_run
from tcbi_sim.model import Model
from tcbi_sim.store import LATEST, ModelStore
from tcbi_sim.tasks import find_task

SCRATCH = "none"
RESTARTS = 3  # of a subprocess that dies
FINE_TUNING_STEPS = 57_600  # two minutes on one core
FINE_TUNING_SETS = 12  # of episodes: so many at least, which are more steps where episodes are long
# rollouts of an evaluation, and pairs of the comparison, for each second of the budget: a short one is for learning
EVALUATED_PER_S, LEAST_EVALUATED = 2.4, 16
PAIRS_PER_S, FEWEST_PAIRS = 4.0, 32
POLL_S = 0.1
OUTCOME = "outcome.json"  # in the folder of a run: the comparison of its policy with its rival
AGAIN = "again"  # in the event of a comparison that was made before, of the same weights
Event = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """A wish for a better policy."""

    task: str
    current: str  # the policy in use, which the successor must beat
    start: str = ""  # to start from: empty for the one in use, "none" for scratch
    model: str = LATEST
    store: Path | None = None
    budget_s: float = 0.0  # 0: no limit in time
    budget_steps: int = 0  # 0: no limit where there is one in time, else the preset's
    seed: int = 0
    threads: int = 0


@dataclass(frozen=True)
class Outcome:
    """What came of a job."""

    accepted: bool
    cancelled: bool
    reference: str  # name of the accepted policy in the store; empty otherwise
    path: str
    return_before: float
    return_after: float
    message: str
    rival: str = ""  # id of the policy that it was compared with


def plan(job: Job) -> Run:
    """The training run of a job.

    Raises:
      TcbiError: an unknown task, model or policy, or a policy of another task to beat or to start from.
    """
    store = ModelStore(job.store)
    model = store.load(job.model)
    check_rig(job.current, model)
    current = find_policy(job.current, store.root)
    config = preset("fast", job.task)
    if isinstance(current, Policy) and current.card.task != job.task:
        remedy = f"whose return on {job.task} can be beaten: name one that ./tcbi policy lists"
        raise TrainingError(describe(f"task of policy {job.current}", current.card.task, job.task, remedy))
    start = _start(job, store.root)
    begun = find_policy(start, store.root) if start else None
    if isinstance(begun, Policy):
        check_start(config, begun)
        config = fine_tuning(config)
        ticks = round(find_task(job.task).duration / CONTROL_PERIOD_S)
        few = max(FINE_TUNING_STEPS, FINE_TUNING_SETS * config.environments * ticks)
        config = dataclasses.replace(config, steps=min(config.steps, few))
    changes: dict[str, Any] = {"seed": job.seed, "budget_s": job.budget_s, "threads": job.threads}
    changes |= randomisation_of(begun or current, job.task, model)
    if not 0 <= job.budget_s < math.inf:
        raise TrainingError(describe("budget_s", job.budget_s, "0 (no limit) or more, s"))
    if job.budget_steps or job.budget_s:
        changes["steps"] = job.budget_steps
    pairs = Run.pairs
    if job.budget_s:
        affordable = max(LEAST_EVALUATED, round(EVALUATED_PER_S * job.budget_s))
        changes["evaluations"] = min(config.evaluations, affordable)
        pairs = min(pairs, max(FEWEST_PAIRS, round(PAIRS_PER_S * job.budget_s)))
    rival = current.policy_id if job.current.startswith(GAIT_PREFIX) else job.current
    config = dataclasses.replace(config, **changes).checked()
    randomised(model, config.effects, config.effect_share)  # refuses what cannot be before a process is started
    return dataclasses.replace(Run.of(config, model, store.root, start, rival), pairs=pairs)


def randomisation_of(policy: Actor, task: str, model: Model) -> dict[str, Any]:
    """The settings for what a policy of this task was trained with, without effects that the model has by now."""
    if not isinstance(policy, Policy) or policy.card.task != task:
        return {}
    card = policy.card.training
    effects = tuple(effect for effect in card.get("effects", ()) if effect not in model.effects)
    share = card.get("effect_share", TrainingConfig.effect_share) if effects else TrainingConfig.effect_share
    return {"observation_noise": card.get("observation_noise", 0.0), "effects": effects, "effect_share": share}


def _start(job: Job, root: Path) -> str:
    reference = job.start or job.current
    if reference == SCRATCH or (not job.start and reference.startswith(GAIT_PREFIX)):
        return ""
    policy = find_policy(reference, root)
    if not isinstance(policy, Policy):
        raise TrainingError(describe("policy to start from", reference, "a trained policy, or none for scratch"))
    if policy.card.task != job.task:
        raise TrainingError(describe(f"task of policy {reference}", policy.card.task, job.task, "or start from none"))
    return reference


def fine_tuning(config: TrainingConfig) -> TrainingConfig:
    """Settings to go on from a policy: learn its value before changing it, explore less, and step more often.

    Small sets of episodes bring more steps of learning out of a short budget; what began as the copy of a gait falls
    apart under large steps (docs/policies.md has the figures).
    """
    return dataclasses.replace(
        config,
        learning_rate=config.learning_rate / 3 if config.imitate else config.learning_rate,
        imitate="",
        warm_up=max(config.warm_up, 2),
        noise=min(config.noise, 0.3),
        environments=min(config.environments, 32),
        batch_size=min(config.batch_size, 128),
        evaluate_every=2 * config.evaluate_every,
    )


def retrain(
    job: Job,
    on_event: Callable[[Event], None],
    cancelled: Callable[[], bool] = lambda: False,
    process: Callable[[], TrainingProcess] = TrainingProcess,
) -> Outcome:
    """Do a job.

    Args:
      job: what to do.
      on_event: receives the events of training_process.py.
      cancelled: asked ten times a second; once it is true the training ends within a second.
      process: gives the process to train in, which may have been standing by.

    Raises:
      TcbiError: the job cannot be done, or the training failed again and again.
    """
    run = plan(job)
    store = ModelStore(job.store)
    folder = write_run(store.folder("runs") / run.key("retrain"), run)
    comparison = _follow(folder, on_event, cancelled, process)
    if comparison is None:
        there = (folder / "checkpoint.safetensors").exists()
        message = f"cancelled; the same request {'goes on from the last checkpoint' if there else 'begins anew'}"
        return Outcome(False, True, "", "", float("nan"), float("nan"), message)
    again = comparison.pop(AGAIN, False)
    before, after = (math.nan if comparison[when] is None else comparison[when] for when in ("before", "after"))
    statement = comparison["statement"] + (" (the same weights as before, whose verdict stands)" if again else "")
    reference, path = "", folder / "policy.safetensors"
    kept = publish(folder, store.root, run.config.task, comparison=comparison) if comparison["better"] else None
    if kept is not None and kept.path is not None:
        reference, path = kept.path.stem, kept.path
    if kept is not None and kept.card.training.get("comparison") == comparison:
        shutil.rmtree(folder, ignore_errors=True)
    else:  # the verdict is counted where it lies; the same request later starts afresh
        (folder / "checkpoint.safetensors").unlink(missing_ok=True)
    return Outcome(comparison["better"], False, reference, str(path), before, after, statement, comparison["rival"])


def _follow(
    folder: Path,
    on_event: Callable[[Event], None],
    cancelled: Callable[[], bool],
    process: Callable[[], TrainingProcess],
) -> Event | None:
    """Run the subprocess, again if it dies; the comparison at its end, or None if cancelled."""
    for attempt in range(RESTARTS + 1):
        try:
            with process() as running:
                running.begin(folder)
                return _listen(running, on_event, cancelled)
        except TrainingError as error:
            if attempt == RESTARTS or "ended with status" in str(error):
                raise
            on_event({"event": "restarted", "reason": str(error)})
    raise TrainingError(f"training in {folder} did not end")


def _listen(process: TrainingProcess, on_event: Callable[[Event], None], cancelled: Callable[[], bool]) -> Event | None:
    """The comparison, which is the last that the process has to say; None if cancelled."""
    while not cancelled():
        event, closed = process.poll(POLL_S)
        if closed:
            process.check()
            raise TrainingError("training ended without a comparison")
        if event is not None:
            on_event(event)
            if event["event"] == "comparison":
                return event
    return None


def publish(folder: Path, root: Path, task: str, name: str = "", comparison: Event | None = None) -> Policy:
    """Keep a run's policy in the store under a name, by default the next free one of its task.

    The card keeps what the policy gained on its rival, if a comparison is given. Without a name, a policy that is there
    already is not kept twice: whoever kept it was killed before the run was gone, or compared it with another rival.
    """
    trained = load_policy(folder / "policy.safetensors")
    training = trained.card.training | ({"comparison": comparison} if comparison else {})
    with locked(root / "policies"):
        if not name and (kept := _kept(root, task, trained)):
            return kept
        name = name or next_name(root, task)
        card = dataclasses.replace(trained.card, name=name, training=training)
        return save_policy(root / "policies" / name, trained.mlp, card)


def _kept(root: Path, task: str, policy: Policy) -> Policy | None:
    """The policy of the store with the same weights and a name that `next_name` gave."""
    for name, path in policy_paths(root).items():
        if name.startswith(f"{task}-") and name.removeprefix(f"{task}-").isdecimal():
            with contextlib.suppress(PolicyError):
                kept = load_policy(path)
                if kept.card.sha256 == policy.card.sha256:
                    return kept
    return None


def next_name(root: Path, task: str) -> str:
    """The first free name `task-<n>` in the store; it stays free while the folder of the policies is `locked`."""
    taken = policy_paths(root)
    return next(name for name in (f"{task}-{n}" for n in range(1, len(taken) + 2)) if name not in taken)


def rival_for(task: str, reference: str, root: Path) -> str:
    """The policy itself, or the newest one for this task where it is for another: what a successor must beat.

    Raises:
      PolicyError: there is none.
    """
    policy = find_policy(reference, root)
    return newest_policy(task, root)[0] if isinstance(policy, Policy) and policy.card.task != task else reference


def reference_of(policy_id: str, root: Path) -> str:
    """The name or gait that a policy id of a running graph stands for.

    Raises:
      PolicyNotFound: it was loaded from a file outside the store, or has been replaced since.
    """
    if policy_id.startswith(GAIT_PREFIX):
        return policy_id
    if name := name_of(policy_id, root):
        return name
    raise PolicyNotFound(f"policy {policy_id} is in use, but not in the store; name the policy to start from")
