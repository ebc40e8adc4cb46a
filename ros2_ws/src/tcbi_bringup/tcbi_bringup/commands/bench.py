"""`./tcbi bench`: measures the product; one script of the checkout's `bench/` a benchmark."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from tcbi_bringup.commands import console
from tcbi_bringup.commands.test import checkout
from tcbi_bringup.errors import BringupError, WrongCallError

SUMMARY = "Measure the product and print each figure beside its target (docs/benchmarks.md)."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which one."""
    parser.add_argument("name", nargs="?", default="", help="of a benchmark; without it they are listed")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    console.add_json(parser)
    console.add_examples(parser, "./tcbi bench", "./tcbi bench lockstep", "./tcbi bench engine --quick --json")


def run(args: argparse.Namespace) -> int:
    """Run a script, pass its figures on. A missed target is a figure, no failure."""
    scripts = {path.stem: path for path in sorted((checkout() / "bench").glob("*.py"))}
    if not args.name:
        console.emit({"benchmarks": list(scripts)}) if args.json else print("\n".join(scripts))
        return 0
    if args.name not in scripts:
        raise WrongCallError(f"unknown benchmark {args.name!r}; there are {', '.join(scripts)}")
    result = json.loads(_output(scripts[args.name], args.quick))
    if args.json:
        console.emit(result)
        return 0
    rows = [[f["name"], f["value"], f["unit"], f["target"], "yes" if f["met"] else "no"] for f in result["figures"]]
    console.table(result["name"], ["figure", "value", "unit", "target", "met"], rows)
    return 0


def _output(script: Path, quick: bool) -> str:
    command = [sys.executable, str(script), *(["--quick"] if quick else [])]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise BringupError(f"{script.name} ended with status {done.returncode}; its last words are above")
    return done.stdout
