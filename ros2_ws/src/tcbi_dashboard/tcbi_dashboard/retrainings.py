"""The policies and the retrainings that a store holds: kept, not kept, or not finished.

A policy that was kept lies in `policies/`, its card with its curve and what it gained; one that was not lies in the
folder of its run, `runs/retrain-…`, where a run that is not finished keeps its last checkpoint.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tcbi_policy.artefact import SHIPPED
from tcbi_policy.retraining import OUTCOME
from tcbi_policy.runs import installed

KEPT, NOT_KEPT, UNFINISHED = "kept", "not kept", "not finished"


@dataclasses.dataclass(frozen=True)
class Retraining:
    """One policy of the store, or one retraining that left none.

    Attributes:
      name: of the policy; of the run's folder where none was kept.
      ended: KEPT, NOT_KEPT or UNFINISHED.
      created: UTC, ISO 8601; "" for one that is not finished.
      model: the version whose posterior it was trained on.
      rival: what it had to beat; "" where nothing was compared.
      said: how it ended, in a sentence.
      curve: control steps and mean return of each evaluation.
    """

    name: str
    ended: str
    task: str
    created: str
    model: str
    rival: str
    said: str
    curve: tuple[tuple[float, float], ...] = ()


def retrainings(root: Path) -> list[Retraining]:
    """All of a store, the newest first, those that are not finished before them."""
    found = [_kept(path) for path in (root / "policies").glob("*.json")]
    present = installed()
    found += [_left(folder, present) for folder in (root / "runs").glob("retrain-*") if folder.is_dir()]
    known = [r for r in found if r is not None]
    return sorted(known, key=lambda r: (r.ended == UNFINISHED, r.created), reverse=True)


def policies(root: Path, task: str) -> list[str]:
    """Names of the policies of a task that can be beaten; the one that `./tcbi retrain` takes by itself is the last."""
    found = []
    for rank, folder in enumerate((SHIPPED, root / "policies")):
        for path in folder.glob("*.json"):
            card = _json(path)
            if card.get("task") == task and path.with_suffix(".safetensors").is_file():
                found.append((rank, rank == 0 and path.stem == task, card.get("created", ""), path.stem))
    return list(dict.fromkeys(name for *_, name in sorted(found)))


def _kept(path: Path) -> Retraining | None:
    card = _json(path)
    if "task" not in card:
        return None
    compared = card.get("training", {}).get("comparison") or {}
    start = f", started from {card['parent']}" if card.get("parent") else ""
    said = (
        compared.get("statement") or f"trained on {card.get('model', '')}{start}; what it gained was not written down"
    )
    return Retraining(
        path.stem, KEPT, card["task"], card.get("created", ""), card.get("model", ""), _name(compared.get("rival", "")),
        said, _curve(card),
    )  # fmt: skip


def _left(folder: Path, present: str) -> Retraining | None:
    run, card = _json(folder / "run.json"), _json(folder / "policy.json")
    if not run:
        return None
    task, model, rival = run["config"]["task"], run["model"], run["rival"]
    if (folder / "checkpoint.safetensors").is_file() or not card:
        budget = run["config"].get("budget_s")
        time = f" with {budget:g} s" if budget else ""
        said = f"goes on where it stopped when the same is asked for again{time}"
        if not run.get("contents", "").endswith(present):
            said = f"begun with other code or libraries; the same request{time} begins afresh"
        return Retraining(folder.name, UNFINISHED, task, "", model, rival, said)
    said = _json(folder / OUTCOME).get("statement") or "not better with confidence; by how much was not written down"
    return Retraining(folder.name, NOT_KEPT, task, card.get("created", ""), model, rival, said, _curve(card))


def _curve(card: Mapping[str, Any]) -> tuple[tuple[float, float], ...]:
    return tuple((e["steps"], e["mean_return"]) for e in card.get("curve", ()))


def _name(policy_id: str) -> str:
    return policy_id.partition("@")[0]


def _json(path: Path) -> dict[str, Any]:
    """What a file holds; nothing where it is not there or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
