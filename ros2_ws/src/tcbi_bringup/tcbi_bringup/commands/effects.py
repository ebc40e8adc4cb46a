"""`./tcbi effects`: the library of physical effects, one of them, or what is wrong with a file of one's own."""

import argparse
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import USAGE
from tcbi_bringup.commands import console
from tcbi_contract.wording import counted

if TYPE_CHECKING:
    from tcbi_sim.effect import Effect
    from tcbi_sim.effect_check import Check
    from tcbi_sim.parameter import Parameter
    from tcbi_sim.rig import Rig

SUMMARY = "List the library of physical effects, show one, or check an effect of your own."
WIDTH = 100  # characters of a line of text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi effects                               # what the hexapod's model may lack",
        "./tcbi effects --rig servo_bench --json",
        "./tcbi effects show backlash                 # physics, source, parameters",
        "./tcbi effects check my_effect.py            # what is wrong with it, each fault in a line",
    )
    parser.add_argument("action", nargs="?", choices=("list", "show", "check"), default="list", help="default: list")
    parser.add_argument("name", nargs="?", metavar="NAME|FILE", help="an effect to show, or a file to check")
    parser.add_argument("--rig", help="the rig that it is for (default: hexapod; for check: every rig)")
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List, show or check."""
    if (args.name is None) != (args.action == "list"):
        console.note(f"tcbi: usage: ./tcbi effects {'list' if args.action == 'list' else args.action + ' NAME|FILE'}")
        return USAGE
    if args.action == "check":
        return _check(Path(args.name), args)
    from tcbi_sim.rigs import load_rig

    rig = load_rig(args.rig or "hexapod")
    return _show(args.name, rig, args) if args.action == "show" else _list(rig, args)


def _list(rig: "Rig", args: argparse.Namespace) -> int:
    from tcbi_sim.effects import candidates, file_of, left_out, library

    fitting = {u.effect.name for u in candidates(rig)}
    effects = [e for e in library().values() if e.name in fitting]
    others = [e for e in library().values() if e.name not in fitting and file_of(e.name) not in left_out()]
    unsuited = {e.name: e.requires(rig) for e in others}
    if args.json:
        files = {str(path): why for path, why in left_out().items()}
        listed = [_as_json(e, rig) for e in effects]
        console.emit({"rig": rig.name, "effects": listed, "unsuited": unsuited, "left_out": files})
        return 0
    rows: list[list[Any]] = []
    for e in effects:
        for k, p in enumerate(e.parameters):
            first = [e.name, _places(e, rig)] if k == 0 else ["", ""]
            rows.append([*first, p.name, p.unit, _range(p), p.nominal, "–" if p.null is None else f"{p.null:g}"])
    head = ["effect", "place", "parameter", "unit", "range (prior)", "nominal", "null"]
    console.table(f"{len(effects)} effects that a model of {rig.name} may lack", head, rows)
    for name, why in unsuited.items():
        print(f"not for {rig.name}: {name}, since {why}")
    print("./tcbi effects show NAME tells the physics and the source; docs/effects.md how to write one of your own.")
    return 0


def _show(name: str, rig: "Rig", args: argparse.Namespace) -> int:
    from tcbi_sim.effects import file_of, library
    from tcbi_sim.errors import UnknownNameError

    name = name.partition(":")[0]
    if name not in library():
        raise UnknownNameError("effect", name, tuple(library()))
    effect = library()[name]
    if args.json:
        console.emit(_as_json(effect, rig))
        return 0
    print(effect.name)
    print(textwrap.fill(effect.physics, WIDTH, initial_indent="  ", subsequent_indent="  "))
    print(textwrap.fill(f"Source: {effect.source}", WIDTH, initial_indent="  ", subsequent_indent="  "))
    if effect.includes:
        print(f"  Includes {', '.join(effect.includes)}")
    why_not = effect.requires(rig)
    print(f"  Not for {rig.name}: {why_not}" if why_not else f"  On {rig.name}: {_places(effect, rig)}")
    if file_of(name):
        print(f"  Your own: {file_of(name)}")
    rows = [
        [p.name, p.unit, _range(p), p.nominal, "–" if p.null is None else f"{p.null:g}", p.description]
        for p in effect.parameters
    ]
    console.table("", ["parameter", "unit", "range (prior)", "nominal", "null", "what it is"], rows)
    return 0


def _check(path: Path, args: argparse.Namespace) -> int:
    from tcbi_sim.effect_check import check_file_apart
    from tcbi_sim.rigs import load_rig, usable_rigs

    rigs = (load_rig(args.rig).name,) if args.rig else usable_rigs()
    with console.progress(f"trying {path.name}"):
        check = check_file_apart(path, rigs)
    if args.json:
        console.emit(_check_as_json(check))
    else:
        _tell(check)
    return 1 if check.faults else 0


def _tell(check: "Check") -> None:
    from tcbi_sim.effect_trial import SIGNALS
    from tcbi_sim.places import effects_folder

    for fault in check.faults:
        print(f"{check.path}: {fault}")
    for trial in check.trials:
        if not trial.faults:
            changes = ", ".join(f"{s} {v:.2g} {SIGNALS[s]}" for s, v in trial.change.items() if v)
            print(f"{trial.use} on {trial.rig}: at its nominal value it changes {changes}; at its null value nothing")
    for rig, why in check.unsuited.items():
        print(f"not for {rig}: {why}")
    if check.faults:
        print(counted(len(check.faults), "fault"))
    elif effects_folder().resolve() != check.path.resolve().parent:
        print(f"fit for use; to use it, copy it to {effects_folder()}, or set TCBI_EFFECTS to its folder")
    else:
        print("fit for use, and in the library")


def _check_as_json(check: "Check") -> dict[str, Any]:
    return {
        "file": str(check.path),
        "effect": check.effect,
        "ok": not check.faults,
        "faults": check.faults,
        "trials": check.trials,
        "unsuited": check.unsuited,
    }


def _as_json(effect: "Effect", rig: "Rig") -> dict[str, Any]:
    from tcbi_sim.effects import file_of

    why_not = effect.requires(rig)
    return {
        "name": effect.name,
        "physics": effect.physics,
        "source": effect.source,
        "rig": rig.name,
        "unsuited": why_not or None,
        "includes": list(effect.includes),
        "sites": [] if why_not else [site for site in effect.sites(rig) if site],
        "file": file_of(effect.name),
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "low": p.low,
                "high": p.high,
                "prior": f"flat, {p.scale} scale",
                "nominal": p.nominal,
                "null": p.null,
                "description": p.description,
            }
            for p in effect.parameters
        ],
    }


def _places(effect: "Effect", rig: "Rig") -> str:
    sites = effect.sites(rig)
    if sites == ("",):
        return "everywhere"
    if set(sites) == set(rig.joint_names):
        return f"each of {len(sites)} joints" if len(sites) > 1 else sites[0]
    return ", ".join(sites)


def _range(p: "Parameter") -> str:
    return f"{p.low:g} to {p.high:g}{' (log)' if p.scale == 'log' else ''}"
