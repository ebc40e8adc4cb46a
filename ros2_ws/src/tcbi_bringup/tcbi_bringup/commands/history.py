"""`./tcbi history`: the error of each model version on rollouts that no fit has seen."""

import argparse
import math
from collections.abc import Mapping

from tcbi_bringup.commands import console

SUMMARY = "Show the error of each model version: with bags on those that no fit has seen, without as diagnoses kept it."

KEPT = (
    "Each figure is what the diagnosis of that version kept: of motions that it sealed, or held out in turn. Those of "
    "different diagnoses were measured on different rollouts; to compare versions, give bags that no fit has seen."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi history                                       # the figures kept with the versions",
        "./tcbi history new_rollouts/*                        # measured now, on these bags",
        "./tcbi history --report history.html --json",
    )
    console.add_bags(parser, " to compare every version on", least=0)
    parser.add_argument("--rig", help="versions of this rig (default: the bags' rig, else hexapod)")
    console.add_report(parser)
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Load every version, compare, report, print."""
    from tcbi_infer.compare.history import history, remember
    from tcbi_infer.report import Report, add_history, file_name
    from tcbi_sim.errors import UnknownNameError
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    measurements = console.read_bags(args)
    console.note_findings(measurements)
    rig = args.rig or (measurements[0].rig if measurements else "hexapod")
    versions = store.history(rig)
    if not versions:
        raise UnknownNameError("rig", rig, tuple(sorted({v.rpartition("-v")[0] for v in store.versions()})))
    lines = history(versions, measurements)
    if measurements and not lines[0].rollouts:
        console.note("all of these rollouts were used in a fit; the figures are those kept with the versions")
    elif left_out := len(measurements) - len(lines[0].rollouts if measurements else ()):
        why = "seen by a fit, repeats of one that was, or without commands"
        console.note(f"{left_out} of {len(measurements)} rollouts left out: {why}")
    nan = float("nan")
    rows = [
        (
            v.model,
            v.parent or "–",
            ", ".join(v.effects) or "none",
            v.error_over_floor if v.error_over_floor is not None else nan,
        )
        for v in lines
    ]
    measured = bool(lines[0].rollouts)
    if measured:
        not_counted = [m.rollout_id for m in measurements if m.rollout_id not in lines[0].rollouts]
        remember(lines, store.folder("runs"), rig, not_counted)
    told = "The error of each version on rollouts that no fit has seen." if measured else KEPT
    report = Report("Model versions", told)
    origins = {v.floor_from_replicates for v in lines}
    estimated = False in origins
    add_history(report, rows, False if estimated else True in origins or None)
    name = file_name("history", versions[-1].version, lines[0].rollouts)
    path = report.write(args.report or store.folder("reports") / name)
    if args.json:
        console.emit({"models": lines, "report": str(path)})
        return 0
    console.table("", ["model", "parent", "effects", "error / noise floor"], rows)
    floor = "the noise floor" + ", estimated where no motion was repeated" * estimated
    print(f"1 is {floor}; – where no rollout unseen by the fits was compared.")
    if not measured:
        print(KEPT)
    elif told := _errs_less({name: error for name, _, _, error in rows}, versions[-1].version):
        print(told)
    print(f"report: {path}")
    return 0


def _errs_less(errors: Mapping[str, float], newest: str) -> str:
    """Which version errs least, where that is not the newest."""
    known = {name: error for name, error in errors.items() if math.isfinite(error)}
    best = min(known, key=lambda name: known[name], default=newest)
    if best == newest or not known[best] < errors[newest]:
        return ""
    return f"{best} errs least; {newest} is the newest, which commands take without --model"
