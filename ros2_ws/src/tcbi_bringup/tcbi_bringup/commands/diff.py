"""`./tcbi diff`: what differs between two model versions."""

import argparse
from typing import TYPE_CHECKING

from tcbi_bringup.commands import console
from tcbi_contract.plain import plain

if TYPE_CHECKING:
    from tcbi_infer.compare.versions import Difference, Interval

SUMMARY = "Show what differs between two model versions: effects, parameters, what each rests on."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi diff hexapod-v0 hexapod-v2",
        "./tcbi diff hexapod-v1 latest --json",
    )
    parser.add_argument("before", metavar="V1", help="a model version, or latest")
    parser.add_argument("after", metavar="V2", help="another one of the same rig")
    parser.add_argument("--rig", default="hexapod", help="whose version latest is (default: hexapod)")
    console.add_report(parser)
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Load both, compare, report, print."""
    from tcbi_infer.compare.versions import compare_versions
    from tcbi_infer.report import Report, add_difference, add_kept_ladder
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    before, after = (store.load(version, args.rig) for version in (args.before, args.after))
    difference = compare_versions(before, after)
    report = Report(f"{before.version} and {after.version}", "What differs between two versions of a model.")
    add_kept_ladder(report, after, store.history(after.rig))
    add_difference(report, difference)
    path = report.write(args.report or store.folder("reports") / f"diff-{before.version}-{after.version}.html")
    if args.json:
        console.emit({**plain(difference), "report": str(path)})
        return 0
    _print(difference)
    print(f"report: {path}")
    return 0


def _print(d: "Difference") -> None:
    print(d.statement)
    rows = [[p.name, p.unit, _span(p.before), _span(p.after), p.overlap, p.width_ratio] for p in d.parameters]
    head = ["parameter", "unit", f"{d.before}: mean (5 % to 95 %)", d.after, "overlap", "width after / before"]
    console.table("", head, rows)
    first, second = d.grounds_before, d.grounds_after
    grounds = [
        ["made by", first.kind, second.kind],
        ["rollouts it was fitted to", str(len(first.rollouts)), str(len(second.rollouts))],
        ["joints' own gains", first.joint_gains, second.joint_gains],
        ["error / noise floor, held out", *(_error(g.error_over_floor) for g in (first, second))],
    ]
    console.table("", ["", d.before, d.after], grounds)
    for version, each in ((d.before, first), (d.after, second)):
        if each.statement:
            print(f"{version}: {each.statement}")
    print("The overlap is the share of the shorter 90 % interval that lies in the other one.")


def _span(interval: "Interval | None") -> str:
    return "–" if interval is None else f"{interval.mean:.3g} ({interval.low90:.3g} to {interval.high90:.3g})"


def _error(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
