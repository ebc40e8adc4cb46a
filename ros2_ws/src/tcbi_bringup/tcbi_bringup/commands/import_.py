"""`./tcbi import`: turns logs of other formats into bags."""

import argparse
import dataclasses
from pathlib import Path

from tcbi_bringup.arguments import at_least
from tcbi_bringup.commands import console

SUMMARY = "Turn JSON or CSV logs into bags that compare, diagnose and infer take like any other."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Mapping, logs, and where the bags go."""
    parser.add_argument(
        "mapping", help="mapping file (TOML), or a built-in mapping: xl330_bench, so101_arm, double_pendulum"
    )
    parser.add_argument(
        "logs", nargs="+", type=Path, metavar="LOG", help="a log (.json, .csv, .gz), or a folder of logs"
    )
    parser.add_argument("--out", type=Path, default=Path("imported"), metavar="FOLDER", help="default: ./imported")
    parser.add_argument(
        "--window",
        type=at_least(0.0),
        metavar="S",
        help="cut each log into rollouts of so many seconds (0: not at all)",
    )
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi import xl330_bench logs/kp100_sin_sin.json --out bags",
        "./tcbi import so101_arm recordings/ --out bags      # a folder holds one folder a recording",
        "./tcbi import so101_arm recordings/ --window 20      # rollouts of 20 s, each recording one kind of motion",
        "./tcbi import my_bench.toml run_*.csv.gz             # docs/bags.md describes the mapping file",
    )


def run(args: argparse.Namespace) -> int:
    """Read every log first, then write: a fault in one, or a bag that is there already, leaves nothing behind."""
    from tcbi_infer.bags.measurement_writer import write_measurement
    from tcbi_infer.bags.writer import check_free
    from tcbi_infer.compare.guards import guard
    from tcbi_infer.importer import logs_in, read_rollouts
    from tcbi_infer.mapping import load_mapping

    mapping = load_mapping(args.mapping)
    if args.window is not None:
        mapping = dataclasses.replace(mapping, window=args.window)
    measurements = [m for log in logs_in(args.logs, mapping) for m in read_rollouts(mapping, log)]
    check_free(args.out, [m.rollout_id for m in measurements])
    rows = []
    for m in measurements:
        bag = write_measurement(args.out, m, torque_commands=mapping.torque_commands)
        rows.append((str(bag), len(m.time), float(m.time[-1]), len(m.commands.time)))
    findings = guard(measurements)
    for finding in findings:
        console.note(f"note: {finding}")
    if args.json:
        keys = ("bag", "samples", "seconds", "commands")
        bags = [dict(zip(keys, row, strict=True)) for row in rows]
        console.emit({"rig": mapping.rig, "bags": bags, "findings": findings})
    else:
        console.table(f"rig {mapping.rig}", ["bag", "samples", "seconds", "commands"], rows)
    return 0
