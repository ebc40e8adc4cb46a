"""Everything that is wrong with a user's own effect file, one plain line each.

check = check_file(Path("my_effect.py"))
check.faults          # empty where the effect is fit for use
"""

from dataclasses import dataclass
from pathlib import Path

from tcbi_sim.effect import Effect, EffectUse
from tcbi_sim.effect_trial import Trial, try_use
from tcbi_sim.effects import built_in, file_of, including, library
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import RIGS, load_rig
from tcbi_sim.user_effects import UserEffectError, incomplete, load_file
from tcbi_sim.user_file import UserFileError, apart, told


@dataclass(frozen=True)
class Check:
    """What was found in one file.

    Attributes:
      effect: its name; None where the file holds no usable one.
      trials: one for each use that was simulated.
      unsuited: rig -> why it cannot have the effect.
      faults: one line each.
    """

    path: Path
    effect: str | None
    trials: tuple[Trial, ...]
    unsuited: dict[str, str]
    faults: tuple[str, ...]


def check_file(path: Path, rigs: tuple[str, ...] = tuple(RIGS)) -> Check:
    """Import a file, look at what it tells, and try it shortly on every rig that it claims to fit."""
    try:
        effect = load_file(path)
    except UserEffectError as e:
        return Check(path, None, (), {}, tuple(e.faults))
    faults = incomplete(effect) + _taken(effect, path) + _unknown(effect)
    unsuited: dict[str, str] = {}
    trials: list[Trial] = []
    where: dict[str, list[str]] = {}  # fault -> rigs
    with including(effect):
        for name in rigs:
            for fault in _on_rig(effect, load_rig(name), path, unsuited, trials):
                where.setdefault(fault, []).append(name)
    faults += [f"on {', '.join(names)}: {fault}" for fault, names in where.items()]
    if len(unsuited) == len(rigs):
        faults.append(
            f"no rig can have it ({'; '.join(f'{r}: {why}' for r, why in unsuited.items())}); change requires"
        )
    return Check(path, effect.name, tuple(trials), unsuited, tuple(faults))


def check_file_apart(path: Path, rigs: tuple[str, ...]) -> Check:
    """The same in a process of its own, so that a file that ends its process, or never ends, has a fault like any."""
    try:
        return apart(check_file, path, rigs)
    except UserFileError as e:
        return Check(path, None, (), {}, tuple(e.faults))


def known_places(rig: Rig) -> set[str]:
    """Every name that a site may have on a rig: legs, joints, feet, groups, and what the MJCF names."""
    spec = rig.build(0)
    parts = (spec.bodies, spec.geoms, spec.sites, spec.joints)
    return {"", *rig.legs, *rig.joint_names, *rig.foot_names, *rig.groups, *(x.name for part in parts for x in part)}


def _taken(effect: Effect, path: Path) -> list[str]:
    if effect.name in built_in():
        return [f"the name {effect.name!r} is taken by a built-in effect; choose another one"]
    other = file_of(effect.name) if effect.name in library() else None
    if other is not None and other.name != path.name:  # of the same name: a copy that is worked on
        return [f"the name {effect.name!r} is taken by {other}; choose another one"]
    return []


def _unknown(effect: Effect) -> list[str]:
    """Effects that it says it includes, and that do not exist."""
    known = [name for name in library() if name != effect.name]
    return [
        f"includes {name!r}, allowed are names of other effects: {', '.join(known)}"
        for name in effect.includes
        if name not in known
    ]


def _on_rig(effect: Effect, rig: Rig, path: Path, unsuited: dict[str, str], trials: list[Trial]) -> list[str]:
    try:
        why_not = effect.requires(rig)
        sites = () if why_not else effect.sites(rig)
    except Exception as e:  # noqa: BLE001 - it is the user's code, which may raise anything
        return [f"requires() or sites(), {told(e, path)}"]
    if not isinstance(why_not, str):
        return [f"requires gives {why_not!r}, allowed is '' or the reason as text"]
    if why_not:
        unsuited[rig.name] = why_not
        return []
    faults = _sites(sites, rig)
    if faults:
        return faults
    for site in dict.fromkeys((sites[0], sites[-1])):
        trial = try_use(EffectUse(effect, site), rig)
        trials.append(trial)
        faults += [f"{trial.use}: {fault}" if site else fault for fault in trial.faults]
    return faults


def _sites(sites: object, rig: Rig) -> list[str]:
    if not isinstance(sites, tuple) or not sites or not all(isinstance(s, str) for s in sites):
        return [f"sites gives {sites!r}, allowed is a tuple of names, or ('',) for an effect without a choice of place"]
    known = known_places(rig)
    return [
        f"site {s!r} does not exist; allowed are '' and names of legs, joints, feet, bodies and shapes"
        for s in sites
        if s not in known
    ]
