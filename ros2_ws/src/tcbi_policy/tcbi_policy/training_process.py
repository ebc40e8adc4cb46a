"""A training run as a process of its own: `Training` in a folder, then the comparison with the run's rival.

    echo RUN_FOLDER | python -m tcbi_policy.training_process

The folder holds `run.json` (see runs.py). Standard output carries the events of training.py, one JSON object a line,
and, where there is a rival, `comparing` and `comparison`, which is kept in the folder, too. `failed` is the last event
of a run that cannot go on: a full disk takes no line of a log.
"""

import dataclasses
import importlib
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tcbi_contract.errors import TcbiError
from tcbi_contract.files import replace_file
from tcbi_policy.artefact import Actor, Policy, find_policy, locked, strict_json
from tcbi_policy.attempts import confidence, known_verdict, next_attempt, verdict_in
from tcbi_policy.configuration import HIGHEST_SEED
from tcbi_policy.errors import TrainingError
from tcbi_policy.evaluation import Comparison, Evaluation, compare_paired, draw_conditions, evaluate, noisy
from tcbi_policy.randomisation import divided, randomised
from tcbi_policy.retraining import AGAIN, OUTCOME
from tcbi_policy.runs import ERRORS, FAILED, LOADED, Run, alone, ended_meanwhile
from tcbi_policy.training import Report, Training
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore

ACCEPTANCE_SEED = 30_000_001  # held out from training and from the choice of the best policy alike


def train_run(folder: Path, report: Report) -> None:
    """Run, or go on with, the training in a folder, and compare its result with the rival.

    Raises:
      TrainingError: the run is for other code or libraries than this process has loaded, or its folder is in use.
    """
    run = Run.from_folder(folder)
    if run.contents and not run.contents.endswith(LOADED):
        raise TrainingError(
            "the code or a library changed after the program that asks for this training (such as a retrain node) had "
            "started; restart that, or give the same command again"
        )
    with alone(folder):
        _train_run(folder, run, report)


def _train_run(folder: Path, run: Run, report: Report) -> None:
    store = ModelStore(run.store or None)
    model = store.load(run.model)
    start = find_policy(run.start, store.root) if run.start else None
    if start is not None and not isinstance(start, Policy):
        raise TrainingError(f"training cannot start from the scripted gait {run.start}; name a trained policy, or none")
    rival = find_policy(run.rival, store.root) if run.rival else None
    model, unseen = divided(model)  # also where nothing is judged: what comes out may start what will be
    policy = Training(folder, run.config, model, start, report).run()
    if rival is None:
        return
    note = ""
    if unseen is model:
        note = ", whose scenarios are new; too few particles bear weight to keep some from the training"
    with locked(store.root / "runs"):  # one is judged at a time, so that no two are the same attempt
        which = (rival.policy_id, run.model, run.config.task)
        known = known_verdict(store.root, policy, *which)  # the same weights are not given a second chance
        if known is None:
            attempt = next_attempt(store.root, *which)
            if not _unchanged(rival, policy):
                report({"event": "comparing", "rival": rival.policy_id, "pairs": run.pairs})
            counted = {key: value for key, value in verdict_in(folder).items() if key == "attempt"}  # made here before
            verdict = counted | judge(rival, policy, unseen, run, attempt, note)
            replace_file(folder / OUTCOME, strict_json(verdict).encode())
    report(verdict if known is None else {**known, AGAIN: True})


def judge(rival: Actor, policy: Policy, model: Model, run: Run, attempt: int, note: str = "") -> dict[str, Any]:
    """The event that tells whether a policy is better than its rival, in words and figures.

    A policy that is the rival itself makes no attempt.
    """
    comparison, also = compare_held_out(rival, policy, model, run, attempt), run.config.randomisation()
    which: dict[str, Any] = {"rival": rival.policy_id, "model": run.model, "task": run.config.task}
    if _unchanged(rival, policy):
        statement = f"not better: the training found nothing better than {rival.policy_id} itself; this is no attempt"
    else:
        which["attempt"] = attempt
        statement = f"{comparison.statement()}, attempt {attempt} against {rival.policy_id} on {run.model}"
        statement += (f", both with {also}" if also else "") + note
    facts = {"better": comparison.better, "statement": statement, **dataclasses.asdict(comparison)}
    return {"event": "comparison", "sha256": policy.card.sha256, **which, **facts}


def compare_held_out(rival: Actor, policy: Policy, model: Model, run: Run, attempt: int = 1) -> Comparison:
    """A policy against its rival on held-out draws, both with the noise and the effects of the run's training.

    Every attempt has rollouts and a confidence of its own.
    """
    config, seed = run.config, ACCEPTANCE_SEED + run.config.seed + (attempt - 1) * (HIGHEST_SEED + 1)
    drawn = randomised(model, config.effects, config.effect_share, seed)
    conditions = draw_conditions(drawn, config.task, run.pairs, seed, systematic=True)
    known = conditions.parameters[:, : len(model.names)]  # those of the effects differ between equal vectors
    vectors = np.unique(known, axis=0, return_inverse=True)[1].ravel()

    def rolled_out(actor: Actor) -> Evaluation:
        return evaluate(noisy(actor, config.observation_noise), drawn, conditions, config.timestep, config.threads)

    before = rolled_out(rival)
    after = before if _unchanged(rival, policy) else rolled_out(policy)
    return compare_paired(before, after, vectors, confidence(attempt))


def _unchanged(rival: Actor, policy: Policy) -> bool:
    """Whether they have the same weights: the best moment of the training was its start."""
    return isinstance(rival, Policy) and rival.card.sha256 == policy.card.sha256


def main() -> int:
    """The subprocess's entry point: standard input names the folder, and ends where nothing more is to be done."""
    _load_libraries()
    name = sys.stdin.readline().strip()
    if not name:
        return 0
    threading.Thread(target=_end_with_the_parent, name="parent", daemon=True).start()
    folder = Path(name)

    def report(event: dict[str, Any]) -> None:
        sys.stdout.write(strict_json(event) + "\n")
        sys.stdout.flush()

    try:
        _log_to(folder / ERRORS)
        train_run(folder, report)
    except BrokenPipeError:  # who asked for it has died
        return 1
    except (TcbiError, OSError) as error:
        report({"event": FAILED, "message": _told(error, folder)})
        return 1
    return 0


def _log_to(path: Path) -> None:
    """Keep in a file what libraries say, and a traceback."""
    with path.open("ab") as errors:
        os.dup2(errors.fileno(), sys.stderr.fileno())


def _told(error: TcbiError | OSError, folder: Path) -> str:
    """What was at fault and what to do, in one line."""
    if isinstance(error, TcbiError):
        return " ".join(str(error).split())
    if isinstance(error, FileNotFoundError) and not folder.exists():
        return ended_meanwhile(folder)
    return (
        f"{error.filename or folder}: {error.strerror or error}; see that there is room on the disk and that it can be "
        "written; the same training then goes on from its last checkpoint"
    )


def _end_with_the_parent() -> None:
    """End this process when standard input ends, wherever it is; what it has learnt up to its checkpoint stays."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(1)


def _load_libraries() -> None:
    """Have everything loaded that torch and the model store would load on first use."""
    torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    importlib.import_module("xarray")


if __name__ == "__main__":
    sys.exit(main())
