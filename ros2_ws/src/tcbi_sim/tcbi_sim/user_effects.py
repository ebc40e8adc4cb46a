"""A user's own effect, one file: read without trusting it, and every fault in one plain line.

effect = load_file(path)       # raises UserEffectError, whose `faults` are lines
"""

import importlib.util
import re
import traceback
from pathlib import Path

from tcbi_contract.errors import TcbiError
from tcbi_sim.effect import Effect
from tcbi_sim.errors import SimError
from tcbi_sim.parameter import Parameter

NAME = re.compile(r"[a-z][a-z0-9_]*")
WORDS = 15  # that a paragraph of physics has at least
MISSING = re.compile(r"(\w+)\.__init__\(\) missing \d+ required positional arguments?: (.+)")


class UserEffectError(SimError):
    """A user's file that holds no usable effect."""

    def __init__(self, path: Path, faults: list[str]):
        self.path, self.faults = path, faults
        super().__init__(f"effect file {path}: {'; '.join(faults)}")


def load_file(path: Path) -> Effect:
    """The EFFECT of a file.

    Raises:
      UserEffectError: the file cannot be imported, or what it defines cannot be used.
    """
    spec = importlib.util.spec_from_file_location(f"tcbi_user_effect_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise UserEffectError(path, ["is no Python file; give the path of a file that ends in .py"])
    module = importlib.util.module_from_spec(spec)
    try:
        exec(compile(path.read_bytes(), path, "exec"), module.__dict__)  # never an older version's bytecode
    except (Exception, SystemExit) as e:  # it is the user's code
        raise UserEffectError(path, [f"cannot be imported: {told(e, path)}"]) from e
    effect = getattr(module, "EFFECT", None)
    if not isinstance(effect, Effect):
        seen = "nothing of that name" if effect is None else f"a {type(effect).__name__}"
        raise UserEffectError(
            path, [f"EFFECT must be an Effect of tcbi_sim.effect, seen {seen}; write EFFECT = Effect(…)"]
        )
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
    if not isinstance(effect.parameters, tuple) or not all(isinstance(p, Parameter) for p in effect.parameters):
        faults.append("parameters must be a tuple of Parameter; write (Parameter(…),) with the comma even for one")
        return faults
    if not effect.parameters:
        faults.append("parameters is empty; an effect needs one at least, whose null value switches it off")
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
    if all(p.null is None for p in effect.parameters):
        faults.append("no parameter has a null value; give the one whose value switches the effect off null=…")
    return faults


def told(error: BaseException, path: Path | str) -> str:
    """An exception of the user's code in a few words, with the line of the file that it came from."""
    if isinstance(error, SyntaxError):
        return f"line {error.lineno}: {error.msg}" if error.lineno else error.msg  # none where it is no text at all
    file = Path(path).resolve()
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == file]
    at = f"line {lines[-1]}: " if lines else ""
    text = " ".join(str(error).split())
    if isinstance(error, TcbiError):
        return f"{at}{text}"
    missing = MISSING.match(text)
    if missing:
        return f"{at}{missing[1]} lacks {missing[2]}; add it"
    return f"{at}{type(error).__name__}: {text}" if text else f"{at}{type(error).__name__}"
