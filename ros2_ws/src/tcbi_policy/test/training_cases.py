"""A tiny training, and one that dies on the way."""

from pathlib import Path
from typing import Any

from tcbi_policy.artefact import Policy
from tcbi_policy.configuration import TrainingConfig
from tcbi_policy.randomisation import divided
from tcbi_policy.training import Training
from tcbi_sim.model import Model, base_model

MODEL = base_model("hexapod")
KEPT, _ = divided(MODEL)  # the part of it that a training process draws from
TINY = TrainingConfig("balance", steps=480, environments=4, batch_size=40, epochs=2, evaluate_every=2, evaluations=2)


class Killed(Exception):
    """Stands for the end of the process."""


def train(
    folder: Path, config: TrainingConfig = TINY, die_after: int = -1, model: Model = MODEL, **options: Any
) -> Policy:
    folder.mkdir(exist_ok=True)
    progress = 0

    def report(event: dict[str, Any]) -> None:
        nonlocal progress
        progress += event["event"] == "progress"
        if event["event"] == "progress" and progress == die_after:
            raise Killed

    return Training(folder, config, model, report=report, **options).run()
