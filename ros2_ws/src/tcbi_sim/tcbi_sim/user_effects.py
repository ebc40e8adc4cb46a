"""A user's own effect, one file: read without trusting it, and every fault in one plain line.

effect = load_file(path)       # raises UserEffectError, whose `faults` are lines
"""

from pathlib import Path

from tcbi_sim.effect import Effect
from tcbi_sim.parameter import Parameter
from tcbi_sim.user_file import NAME, UserFileError, read_one

WORDS = 15  # that a paragraph of physics has at least


class UserEffectError(UserFileError):
    """A user's file that holds no usable effect."""

    holds = "effect"


def load_file(path: Path) -> Effect:
    """The EFFECT of a file.

    Raises:
      UserEffectError: the file cannot be imported, or what it defines cannot be used.
    """
    effect = read_one(path, "EFFECT", Effect, UserEffectError)
    faults = unusable(effect)
    if faults:
        raise UserEffectError(path, faults)
    return effect


def unusable(effect: Effect) -> list[str]:
    """What would break a model that has this effect."""
    faults = []
    if not isinstance(effect.name, str) or not NAME.fullmatch(effect.name):
        faults.append(f"name is {effect.name!r}, allowed are small letters, digits and _, such as 'my_effect'")
    for part in ("apply", "edit", "update", "sites", "requires"):
        value = getattr(effect, part)
        if not callable(value) and not (value is None and part in ("edit", "update")):
            faults.append(f"{part} is {value!r}, allowed is a function")
    if not isinstance(effect.includes, tuple) or not all(isinstance(name, str) for name in effect.includes):
        faults.append(f"includes is {effect.includes!r}, allowed is a tuple of effects' names, such as ('payload',)")
    if not isinstance(effect.parameters, tuple) or not all(isinstance(p, Parameter) for p in effect.parameters):
        faults.append("parameters must be a tuple of Parameter; write (Parameter(…),) with the comma even for one")
        return faults
    if not effect.parameters:
        faults.append("parameters is empty; an effect needs one at least, whose null value switches it off")
    elif all(p.null is None for p in effect.parameters):
        faults.append("no parameter has a null value; give the one whose value switches the effect off null=…")
    names = [p.name for p in effect.parameters]
    faults += [
        f"parameter {n!r}: allowed are small letters, digits and _"
        for n in names
        if not isinstance(n, str) or not NAME.fullmatch(n)
    ]
    faults += [
        f"parameter {n!r} is there {names.count(n)} times; give each its own name"
        for n in sorted(set(names))
        if names.count(n) > 1
    ]
    return faults


def incomplete(effect: Effect) -> list[str]:
    """What an effect does not tell of itself."""
    faults = []
    words = len(str(effect.physics or "").split())
    if words < WORDS:
        faults.append(
            f"physics has {words} words, a paragraph of at least {WORDS} is wanted; say what happens and how it shows"
        )
    if not str(effect.source or "").strip():
        faults.append("source is empty; say where the effect and its size are known from")
    for p in effect.parameters:
        if not str(p.unit or "").strip():
            faults.append(f"parameter {p.name!r} has no unit; write an SI unit, or '1' for a pure number")
        if not str(p.description or "").strip():
            faults.append(f"parameter {p.name!r} has no description; say in a few words what it measures")
    return faults
