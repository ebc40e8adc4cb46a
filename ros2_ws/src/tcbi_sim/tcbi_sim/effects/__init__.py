"""The library of physical effects, one file each, by name: the built-in ones, and the user's own.

The user's own lie in the folder that TCBI_EFFECTS names, else in `effects` of the store (docs/effects.md). One of them
that cannot be used is left out with a line in the log, which a command shows on standard error, and everything else
goes on.
"""

import contextlib
import functools
import importlib
import logging
import os
import pkgutil
from collections.abc import Iterator
from pathlib import Path

from tcbi_contract.errors import TcbiError
from tcbi_sim.effect import Effect, EffectUse
from tcbi_sim.errors import EffectError, SimError, UnknownNameError, UnknownSiteError
from tcbi_sim.places import USER_EFFECTS, effects_folder
from tcbi_sim.rig import Rig
from tcbi_sim.user_effects import UserEffectError, load_file
from tcbi_sim.user_file import included, python_files, told

log = logging.getLogger(__name__)
_files: dict[str, Path] = {}  # the user's own effects, by name
_left_out: dict[Path, str] = {}  # files that are left out, and why
_probed: dict[tuple[str, str], bool] = {}  # (effect, rig) of the user's own effects: whether it runs


@functools.cache
def library() -> dict[str, Effect]:
    """All effects by name: the built-in ones, then the user's own, without those that cannot be used."""
    effects = dict(built_in())
    for known in (_files, _left_out, _probed):
        known.clear()
    for path in user_files():
        try:
            effect = load_file(path)
            if effect.name in effects:
                by = _files[effect.name].name if effect.name in _files else "a built-in effect"
                fault = f"the name {effect.name!r} is taken already, by {by}; choose another one"
                raise UserEffectError(path, [fault])
        except UserEffectError as e:
            _leave_out(path, "; ".join(e.faults))
            continue
        effects[effect.name], _files[effect.name] = effect, path
    return effects


@functools.cache
def built_in() -> dict[str, Effect]:
    """The effects that come with this package, by name."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    return {m.EFFECT.name: m.EFFECT for m in modules}


def user_files() -> list[Path]:
    """The files in the user's own folder, in the order in which they are read; names that begin with _ or . are not."""
    folder = effects_folder()
    if os.environ.get(USER_EFFECTS) and not folder.is_dir():
        _leave_out(folder, f"is no folder; make it, or unset {USER_EFFECTS}")
    return python_files(folder)


def file_of(name: str) -> Path | None:
    """The user's file that defines an effect; None for a built-in one."""
    library()
    return _files.get(name)


def left_out() -> dict[Path, str]:
    """The user's files that are left out of the library, and why."""
    library()
    return dict(_left_out)


@contextlib.contextmanager
def including(effect: Effect) -> Iterator[None]:
    """The library with one more effect for a while, which hides one of the same name."""
    with included(library(), effect.name, effect):
        yield


def find_use(key: str, rig: Rig) -> EffectUse:
    """The use of an effect that `key` ("name" or "name:site") writes, checked against the rig.

    Raises:
      SimError: unknown effect or site, or an effect that this rig cannot have.
    """
    name, _, site = key.partition(":")
    effects = library()
    if name not in effects:
        if _left_out:
            files = ", ".join(p.name for p in _left_out)
            raise SimError(f"unknown effect {name!r}; it may be in a file that was left out: {files}; mend that file")
        raise UnknownNameError("effect", name, tuple(effects))
    effect = effects[name]
    why_not, sites = _fit(effect, rig)
    if why_not:
        raise SimError(f"effect {name!r} does not suit the rig {rig.name!r}: {why_not}")
    if site not in sites:
        raise UnknownSiteError(name, site, sites)
    return EffectUse(effect, site)


def candidates(rig: Rig) -> list[EffectUse]:
    """Every use of every effect that this rig can have; one of the user's own only if it runs."""
    uses = []
    for name, effect in list(library().items()):
        path = _files.get(name)
        if path is not None and not _runs(effect, rig, path):
            continue
        if not effect.requires(rig):
            uses += [EffectUse(effect, site) for site in effect.sites(rig)]
    return uses


def _runs(effect: Effect, rig: Rig, path: Path) -> bool:
    """Whether a user's own effect gets through one sample on this rig; found out once, said where not."""
    key = (effect.name, rig.name)
    if key not in _probed:
        try:
            if not effect.requires(rig):
                _probe(effect, rig)
            _probed[key] = True
        except Exception as e:  # noqa: BLE001 - it is the user's code, which may raise anything
            _probed[key] = False
            _leave_out(path, f"does not run on {rig.name}: {told(e, path)}")
    return _probed[key]


def _fit(effect: Effect, rig: Rig) -> tuple[str, tuple[str, ...]]:
    """Why a rig cannot have an effect, and the sites where it can."""
    part = "requires"
    try:
        why_not = effect.requires(rig)
        part = "sites"
        return why_not, () if why_not else effect.sites(rig)
    except TcbiError:
        raise
    except Exception as e:
        raise EffectError(effect.name, part, e, effect.apply.__code__.co_filename) from e


def _probe(effect: Effect, rig: Rig) -> None:
    import numpy as np

    from tcbi_sim.measurement import Scenario
    from tcbi_sim.model import base_model
    from tcbi_sim.simulator import Simulator

    for site in effect.sites(rig):
        model = base_model(rig).with_effect(EffectUse(effect, site).key)
        values = np.array([[p.nominal for p in model.parameters]])
        simulator = Simulator(model, values, [Scenario("probe", 1.0, settle=0.0)], threads=1)
        simulator.advance(1 / simulator.rate)


def _leave_out(path: Path, why: str) -> None:
    _left_out[path] = why
    log.warning("tcbi: own effects: %s is left out: %s", path, " ".join(why.split()))
