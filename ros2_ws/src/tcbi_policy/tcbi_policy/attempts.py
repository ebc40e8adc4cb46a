"""Which attempt to beat a policy this is, and with what confidence it must succeed.

Whoever tries again and again is lucky once. So the n-th attempt against the same rival, on the same model version and
task, may be wrong with a probability of 0.05 / (n (n + 1)) only: whatever their number, these sum to 0.05. Attempts are
counted by the verdicts that are kept, in the folders of runs and in the cards of policies; an accepted policy is
another rival, against which the count begins anew. A training that found nothing better than its rival itself is none.
"""

import json
from pathlib import Path
from typing import Any

from tcbi_policy.artefact import Policy, load_all, policy_paths
from tcbi_policy.errors import TrainingError
from tcbi_policy.retraining import OUTCOME

FALSE_ALARMS = 0.05  # probability that any attempt against a rival is accepted that is no better


def confidence(attempt: int) -> float:
    """What the n-th attempt is judged with: 0.975, 0.9917, 0.9958, ..."""
    return 1.0 - FALSE_ALARMS / (attempt * (attempt + 1))


def next_attempt(root: Path, rival: str, model: str, task: str) -> int:
    """The number, from 1, of the next attempt against a rival (its id) on a model version and a task.

    Raises:
      TrainingError: a verdict in the store cannot be read.
    """
    asked = {"rival": rival, "model": model, "task": task}
    return 1 + max((found.get("attempt", 0) for found in _verdicts(root) if asked.items() <= found.items()), default=0)


def known_verdict(root: Path, policy: Policy, rival: str, model: str, task: str) -> dict[str, Any] | None:
    """What was found of these weights against this rival (its id) on a model version and a task, if they were judged.

    Raises:
      TrainingError: a verdict in the store cannot be read.
    """
    asked = {"sha256": policy.card.sha256, "rival": rival, "model": model, "task": task}
    return next((found for found in _verdicts(root) if asked.items() <= found.items()), None)


def _verdicts(root: Path) -> list[dict[str, Any]]:
    kept = [verdict_in(path.parent) for path in (root / "runs").glob(f"*/{OUTCOME}")]
    policies, _ = load_all(policy_paths(root))  # second: the folder of an accepted one goes when its card is there
    return kept + [policy.card.training.get("comparison") or {} for policy in policies.values()]


def verdict_in(folder: Path) -> dict[str, Any]:
    """What was found of the policy that a run's folder holds; empty where nothing was compared yet.

    Raises:
      TrainingError: it cannot be read.
    """
    path = folder / OUTCOME
    try:
        return dict(json.loads(path.read_text()))
    except FileNotFoundError:
        return {}
    except ValueError as e:
        raise TrainingError(f"{path} cannot be read ({e}), so attempts cannot be counted; remove it") from e
