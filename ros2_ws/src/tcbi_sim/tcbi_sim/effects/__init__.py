"""The library of physical effects, one file each, by name."""

import functools
import importlib.util
import os
import pkgutil
from pathlib import Path
from types import ModuleType

from tcbi_sim.effect import Effect, EffectUse
from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.rig import Rig

USER_FOLDER = "TCBI_EFFECTS"  # environment variable: a folder with the user's own effect files


@functools.cache
def library() -> dict[str, Effect]:
    """All effects by name: the built-in ones, then those in the folder that TCBI_EFFECTS names.

    Raises:
      SimError: a file defines no effect, or a name twice.
    """
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    folder = os.environ.get(USER_FOLDER)
    if folder:
        modules += [_load(path) for path in sorted(Path(folder).glob("*.py"))]
    effects: dict[str, Effect] = {}
    for module in modules:
        effect = getattr(module, "EFFECT", None)
        if not isinstance(effect, Effect):
            raise SimError(f"{module.__file__} defines no EFFECT of type Effect")
        if effect.name in effects:
            raise SimError(f"effect {effect.name!r} is defined twice, the second time in {module.__file__}")
        effects[effect.name] = effect
    return effects


def find_use(key: str, rig: Rig) -> EffectUse:
    """The use of an effect that `key` ("name" or "name:site") writes, checked against the rig.

    Raises:
      SimError: unknown effect or site, or an effect that this rig cannot have.
    """
    name, _, site = key.partition(":")
    effects = library()
    if name not in effects:
        raise UnknownNameError("effect", name, tuple(effects))
    effect = effects[name]
    why_not = effect.requires(rig)
    if why_not:
        raise SimError(f"effect {name!r} does not suit the rig {rig.name!r}: {why_not}")
    sites = effect.sites(rig)
    if site not in sites:
        raise SimError(
            f"effect {name!r}: site {site!r}, allowed is one of {', '.join(map(repr, sites))}; write name:site"
        )
    return EffectUse(effect, site)


def candidates(rig: Rig) -> list[EffectUse]:
    """Every use of every effect that this rig can have."""
    return [EffectUse(e, site) for e in library().values() if not e.requires(rig) for site in e.sites(rig)]


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"tcbi_user_effect_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
