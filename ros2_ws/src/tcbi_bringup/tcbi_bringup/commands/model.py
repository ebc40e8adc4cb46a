"""`./tcbi model`: list, show and delete model versions, and have a running graph take one."""

import argparse
import dataclasses
import sys
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import namespace
from tcbi_bringup.commands import console
from tcbi_bringup.errors import WrongCallError
from tcbi_contract.plain import plain

if TYPE_CHECKING:
    from tcbi_sim.model import Model
    from tcbi_sim.store import ModelStore

SUMMARY = "List the model versions, show one, fix what was measured otherwise, have a graph use one, or delete one."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to look at."""
    console.add_examples(
        parser,
        "./tcbi model                                         # all versions of all rigs",
        "./tcbi model hexapod-v2 --json",
        "./tcbi model hexapod-v0 --fix mass=0.86              # what scales say is fitted no more: a new version",
        "./tcbi model latest --use                            # the sim node that runs simulates it from now on",
        "./tcbi model hexapod-v3 --delete                     # an inference or an effect that one does not want",
    )
    parser.epilog = f"{parser.epilog}\n\n{_WHAT_HAPPENS}"
    parser.add_argument("version", nargs="?", default="", help="a model version, or latest; nothing lists all")
    parser.add_argument("--delete", action="store_true", help="delete it; one that others were made from is refused")
    parser.add_argument(
        "--fix",
        type=_value,
        action="append",
        metavar="NAME=VALUE",
        help="make a version in which a parameter stays at a value that was measured otherwise (in the unit that the "
        "version shows); as often as it is given",
    )
    parser.add_argument(
        "--free", action="append", metavar="NAME", help="make a version in which a fixed parameter is fitted again"
    )
    parser.add_argument("--use", action="store_true", help="have the graph's sim node and inference node take it")
    parser.add_argument("--namespace", type=namespace, default="", help="of the graph, for --use")
    parser.add_argument("--rig", default="", help="list this rig's; whose version latest is (default: hexapod)")
    console.add_store(parser)
    console.add_json(parser)


_WHAT_HAPPENS = """A sim node keeps its version until --use names another one, between two rollouts: what is recorded
of it is of one. An inference node that was told none, a training and every command take the newest as they begin.

Where no version is named, every command and every node takes the newest. Deleting it makes the one
before the newest again; its number is not given again, and policies that were trained on it stay."""


def _value(text: str) -> tuple[str, float]:
    """A parameter's name and value, of "mass=0.86".

    Raises:
      argparse.ArgumentTypeError: it is no such thing.
    """
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a parameter and its value, as in mass=0.86") from None


def run(args: argparse.Namespace) -> int:
    """List, show, fix, use or delete."""
    from tcbi_sim.store import LATEST, ModelStore

    store = ModelStore(args.store)
    asked = [option for option in ("delete", "use", "fix", "free") if getattr(args, option)]
    if asked and not args.version:
        raise WrongCallError(f"--{asked[0]}: got no model version; name one that ./tcbi model lists")
    if len(asked) > 1 and asked != ["fix", "free"]:
        raise WrongCallError(f"--{asked[0]} and --{asked[1]}: got both, allowed is one of them")
    if args.namespace and not args.use:
        raise WrongCallError("--namespace: names the graph for --use, which was not given")
    if not args.version:
        return _list(args, store)
    if args.fix or args.free:
        return _fix(args, store)
    if args.use:
        return _use(args, store)
    if args.delete:
        if args.version == LATEST:
            raise WrongCallError("--delete: got latest, allowed is a version by its number; ./tcbi model lists them")
        return _delete(args, store)
    return _show(args, store)


def _list(args: argparse.Namespace, store: "ModelStore") -> int:
    versions = store.history(args.rig or None)
    newest = {model.rig: store.versions(model.rig)[-1] for model in versions}  # be it damaged
    facts = [{**_facts(model), "newest": newest[model.rig] == model.version} for model in versions]
    if args.json:
        console.emit({"models": facts})
        return 0
    rows = [
        [
            f["model"],
            f["parent"] or "–",
            f["made_by"],
            ", ".join(f["effects"]) or "none",
            str(f["rollouts"] or "–"),
            _error(f),
            (f["created"] or "–")[:16].replace("T", " "),
        ]
        for f in facts
    ]
    columns = ["model", "parent", "made by", "effects", "rollouts", "error / noise floor", "made (UTC)"]
    console.table("", columns, rows)
    print(f"newest, taken where none is named: {', '.join(newest.values())}")
    return 0


def _show(args: argparse.Namespace, store: "ModelStore") -> int:
    from tcbi_infer.compare.versions import intervals

    model = store.load(args.version, args.rig or "hexapod")
    facts = _facts(model)
    spans = intervals(model)
    parameters = [{"name": p.name, "unit": p.unit, **plain(spans[p.name])} for p in model.parameters]
    children = [m.version for m in store.history(model.rig) if m.parent == model.version]
    if args.json:
        console.emit({**facts, "parameters": parameters, "children": children})
        return 0
    rows = [
        ["parent", model.parent or "–"],
        ["made by", facts["made_by"]],
        ["made (UTC)", facts["created"] or "–"],
        ["effects", ", ".join(model.effects) or "none"],
        ["fixed", model.fixed_told],
        ["rollouts it was fitted to", str(facts["rollouts"])],
        ["joints' own gains", facts["joint_gains"]],
        ["error / noise floor, held out", _error(facts)],
        ["versions made from it", ", ".join(children) or "none"],
    ]
    console.table(model.version, ["what", "value"], rows)
    if facts["statement"]:
        print(facts["statement"])
    for warning in facts["warnings"]:
        print(warning)
    rows = [[p["name"], p["unit"], p["mean"], p["low90"], p["high90"]] for p in parameters]
    console.table("parameters", ["parameter", "unit", "mean", "5 %", "95 %"], rows)
    return 0


def _fix(args: argparse.Namespace, store: "ModelStore") -> int:
    model = store.load(args.version, args.rig or "hexapod")
    if args.free:
        model = model.with_free(args.free)
    saved = store.save(model.with_fixed(dict(args.fix)) if args.fix else model)
    seen = bool(saved.fit.rollouts)
    if args.json:
        console.emit({"model": saved.version, "parent": saved.parent, "fixed": saved.fixed, "parameters": saved.names})
        return 0
    print(f"{saved.version}: fixed is {saved.fixed_told}; fitted are {', '.join(saved.names)}")
    if seen:
        print("The others were not fitted beside this: fit them again (./tcbi infer, or ./tcbi diagnose and add).")
    return 0


def _use(args: argparse.Namespace, store: "ModelStore") -> int:
    from tcbi_bringup.model_loader import load_model

    store.load(args.version, args.rig or "hexapod")  # a wrong name is told before a graph is looked for
    taken = load_model(args.version, args.namespace)
    if args.json:
        console.emit({"nodes": [dataclasses.asdict(answer) for answer in taken]})
    for answer in taken:
        if answer.problem:
            print(f"{answer.node}: {answer.problem}", file=sys.stderr)
        elif not args.json:
            print(f"the {answer.node} has {answer.model} now")
    return 1 if any(answer.problem for answer in taken) else 0


def _delete(args: argparse.Namespace, store: "ModelStore") -> int:
    store.delete(args.version)
    newest = store.versions(args.version.rpartition("-v")[0])[-1]
    if args.json:
        console.emit({"deleted": args.version, "newest": newest})
    else:
        print(f"{args.version} is deleted; the newest is now {newest}")
    return 0


def _error(facts: dict[str, Any]) -> str:
    return "–" if facts["error_over_floor"] is None else f"{facts['error_over_floor']:.3g}"


def _facts(model: "Model") -> dict[str, Any]:
    from tcbi_infer.compare.versions import grounds_of

    grounds = grounds_of(model)
    return {
        "model": model.version,
        "rig": model.rig,
        "parent": model.parent,
        "made_by": grounds.kind,
        "created": model.created,
        "effects": model.effects,
        "rollouts": len(grounds.rollouts),
        "error_over_floor": grounds.error_over_floor,
        "joint_gains": grounds.joint_gains,
        "fixed": model.fixed,
        "statement": grounds.statement,
        "warnings": model.evidence.get("inference", {}).get("warnings", ()),
    }
