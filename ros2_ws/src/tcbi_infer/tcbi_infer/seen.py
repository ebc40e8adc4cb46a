"""Which rollouts a model has seen: nothing may be judged on what it was fitted to."""

from tcbi_sim.model import Model


def used_before(model: Model) -> set[str]:
    """The rollouts that made a model version's distribution."""
    inference = model.evidence.get("inference") or {}
    return {*model.evidence.get("rollouts", ()), *inference.get("rollouts", ())}
