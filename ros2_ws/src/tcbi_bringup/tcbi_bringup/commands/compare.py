"""`./tcbi compare`: the error of a model on bags, per signal and joint, beside the noise floor."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tcbi_bringup.arguments import between, timestep
from tcbi_bringup.commands import console
from tcbi_contract.wording import counted

if TYPE_CHECKING:
    from tcbi_infer.compare import Comparison
    from tcbi_infer.compare.ladder import Rung

SUMMARY = "Replay recorded commands in a model and measure the error of every signal beside the noise floor."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi compare rollouts/*                             # the latest model",
        "./tcbi compare rollouts/* --model hexapod-v0 --report compare.html",
        "./tcbi compare rollouts/* --json",
    )
    console.add_bags(parser)
    console.add_model(parser)
    console.add_report(parser)
    parser.add_argument(
        "--timestep",
        type=timestep,
        help="s at most, of a step (default: 0.002, or a half or quarter of it where that matters)",
    )
    parser.add_argument(
        "--particles",
        type=between(0, 256),
        default=16,
        help="draws of the parameters for the predictive bands, at most 256 (default: 16)",
    )
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read, compare, report, print."""
    from tcbi_infer.compare import compare
    from tcbi_infer.compare.ladder import ladder, lineage
    from tcbi_infer.report import Report, add_comparison, file_name
    from tcbi_sim.store import ModelStore

    measurements = console.read_bags(args)
    store = ModelStore(args.store)
    model = store.load(args.model, measurements[0].rig)
    console.note(f"replaying {counted(len(measurements), 'rollout')} in {model.version}")
    comparison = compare(model, measurements, timestep=args.timestep, particles=args.particles)
    line = lineage(model, store.history(model.rig))
    rungs = ladder(comparison, line, measurements)
    report = Report(
        "Model against measurement", f"Model {model.version}, {counted(len(comparison.rollouts), 'rollout')}."
    )
    add_comparison(report, comparison, rungs=rungs)
    name = file_name("compare", model.version, comparison.rollouts)
    path = report.write(args.report or store.folder("reports") / name)
    if args.json:
        console.emit({**comparison.to_json(), "ladder": rungs, "report": str(path)})
    else:
        _print(comparison, rungs, path)
    return 0


def _print(comparison: "Comparison", rungs: "Sequence[Rung]", path: Path) -> None:
    for line in (*comparison.guards, *comparison.not_checked):
        print(f"note: {line}")
    seen = {True: " (fitted to some of these)", False: ""}
    console.ladder([(rung.label + seen[rung.fitted_here], rung.error_over_floor) for rung in rungs])
    print(comparison.floor.statement)
    errors = (*comparison.signals, *comparison.statistics)
    rows = [[s.name, s.unit, s.error, s.noise_floor, s.floor_from, s.ratio, s.coverage90, s.crps] for s in errors]
    head = ["signal", "unit", "error", "noise floor", "from", "error / floor", "inside 90 % band", "CRPS"]
    console.table(f"{comparison.model} on {counted(len(comparison.rollouts), 'rollout')}", head, rows)
    for finding in comparison.where:
        print(f"  {finding.statement}")
    moments = [[w.rollout, w.time, w.signal, w.error, w.unit, w.error_over_floor] for w in comparison.worst]
    if moments:
        console.table("worst moments", ["rollout", "from / s", "signal", "error", "unit", "error / floor"], moments)
    print(f"report: {path}")
