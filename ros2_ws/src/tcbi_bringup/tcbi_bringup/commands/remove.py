"""`./tcbi remove`: a new model version without one of its effects."""

import argparse
import dataclasses

from tcbi_bringup.commands import console

SUMMARY = "Make a new model version without one of its effects; the old versions stay."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi remove backlash                               # from the newest version",
        "./tcbi remove weak_leg:lm --model hexapod-v2 --json",
    )
    parser.epilog = f"{parser.epilog}\n\n{_WHAT_HAPPENS}"
    parser.add_argument("effect", help="an effect of the model, name or name:site")
    console.add_model(parser, "the parent version")
    parser.add_argument("--rig", default="hexapod", help="whose newest version (default: hexapod)")
    console.add_report(parser)
    console.add_store(parser)
    console.add_json(parser)


_WHAT_HAPPENS = """The effect's own parameters are marginalised out: every particle keeps its weight and its values of
all other parameters. Those that had been fitted beside the effect are named: without it they are no fit."""


def run(args: argparse.Namespace) -> int:
    """Marginalise, save the version, report, print."""
    from tcbi_infer.compare.versions import compare_versions, marginal_evidence
    from tcbi_infer.report import Report, add_difference, add_kept_ladder
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    parent = console.load_model(store, args.model, args.rig)
    child = parent.without_effect(args.effect)
    (use,) = set(parent.effects) - set(child.effects)
    saved = store.save(dataclasses.replace(child, evidence=marginal_evidence(parent, use)))
    report = Report(f"{saved.version}: {parent.version} without {use}", saved.evidence["statement"])
    add_kept_ladder(report, parent, store.history(parent.rig))
    add_difference(report, compare_versions(parent, saved))
    path = report.write(args.report or store.folder("reports") / f"remove-{saved.version}.html")
    if args.json:
        console.emit(
            {
                "model": saved.version,
                "parent": parent.version,
                "effect": use,
                "effects": saved.effects,
                "statement": saved.evidence["statement"],
                "linked": saved.evidence["linked"],
                "report": str(path),
            }
        )
        return 0
    print(f"{saved.version} = {parent.version} without {use}; {parent.version} stays")
    print(saved.evidence["statement"])
    rows = [[p.name, p.unit, float(v)] for p, v in zip(saved.parameters, saved.mean(), strict=True)]
    console.table("mean parameters", ["parameter", "unit", "mean"], rows)
    print(f"measure it: ./tcbi compare BAG… --model {saved.version}; fit it: ./tcbi infer BAG… --model {saved.version}")
    print(f"report: {path}")
    return 0
