"""Which rollouts a model has seen: nothing may be judged on what it was fitted to."""

from tcbi_sim.model import Model


def used_before(model: Model) -> set[str]:
    """The rollouts that made a model version's distribution, its prior and particles kept from its parent included."""
    return set(model.fit.rollouts)
