"""What tests of retraining share: a tiny training, a job, a policy that was trained with randomisation."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from tcbi_policy import retraining
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.configuration import TrainingConfig
from tcbi_policy.retraining import Job

TINY = TrainingConfig("balance", steps=320, environments=4, batch_size=40, epochs=2, evaluate_every=2, evaluations=2)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings of a second."""
    monkeypatch.setattr(retraining, "preset", lambda name, task: dataclasses.replace(TINY, task=task))


def job(tmp_path: Path, **changes: Any) -> Job:
    """A job on the shipped policy."""
    return dataclasses.replace(Job("balance", current="balance", store=tmp_path), **changes)


def robust(tmp_path: Path, **training: Any) -> Policy:
    """A policy in the store whose card says what else it was trained with."""
    shipped = find_policy("balance")
    assert isinstance(shipped, Policy)
    card = dataclasses.replace(shipped.card, name="robust", training={**shipped.card.training, **training})
    return save_policy(tmp_path / "policies" / "robust", shipped.mlp, card)
