"""Which effects a diagnosis tries."""

from collections.abc import Sequence

from tcbi_infer.diagnose.settings import Settings
from tcbi_sim.effect import EffectUse
from tcbi_sim.effects import candidates
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig


def library(model: Model) -> list[EffectUse]:
    """Every use of every effect that the model has not got yet."""
    return [u for u in candidates(load_rig(model.rig)) if u.key not in model.effects]


def untried(model: Model, uses: Sequence[str]) -> tuple[str, ...]:
    """The uses of the library that are not among those tried."""
    return tuple(u.key for u in library(model) if u.key not in uses)


def tried(model: Model, settings: Settings) -> list[str]:
    """The uses that a diagnosis tries where none are named."""
    single = () if settings.per_joint else load_rig(model.rig).joint_names
    return [u.key for u in library(model) if u.site not in single]


def find_candidates(model: Model, wanted: Sequence[str]) -> list[str]:
    """The uses that effects' names ("weak_leg", at all its sites) or single uses ("weak_leg:lf") stand for.

    Raises:
      UnknownNameError: one of them is none, or is in the model already.
    """
    every = library(model)
    known = dict.fromkeys([u.effect.name for u in every] + [u.key for u in every])
    for name in wanted:
        if name not in known:
            raise UnknownNameError(f"candidate for {model.version}", name, tuple(known))
    return [u.key for u in every if u.key in wanted or u.effect.name in wanted]
