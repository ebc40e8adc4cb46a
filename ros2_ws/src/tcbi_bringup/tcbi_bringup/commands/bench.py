"""`./tcbi bench`: measures the product; one script or folder of the checkout's `bench/` a benchmark."""

import argparse
import ast
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

from tcbi_bringup.commands import console
from tcbi_bringup.commands.test import checkout
from tcbi_bringup.errors import BringupError, WrongCallError

TAKES_BEHIND_DASHES = "options"  # the argument that gets what stands behind `--`
SUMMARY = "Measure the product and print each figure beside its target (docs/benchmarks.md)."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which one."""
    parser.add_argument("name", nargs="?", default="", help="of a benchmark; without it they are listed")
    parser.add_argument("options", nargs="*", metavar="-- OPTION", help="a benchmark's own; -- --help lists them")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi bench",
        "./tcbi bench lockstep",
        "./tcbi bench engine --quick --json",
        "./tcbi bench hidden -- --plan bench --hidden all --seeds 400:405 --keep all.jsonl",
        "./tcbi bench hidden -- --help",
    )


def run(args: argparse.Namespace) -> int:
    """Run a script, pass its figures on. A missed target is a figure, no failure."""
    folder = checkout() / "bench"
    scripts = {path.stem: path for path in [*folder.glob("*.py"), *(p.parent for p in folder.glob("*/__main__.py"))]}
    scripts = dict(sorted(scripts.items()))
    if not args.name:
        _list(scripts, args.json)
        return 0
    if args.name not in scripts:
        raise WrongCallError(f"unknown benchmark {args.name!r}; there are {', '.join(scripts)}")
    options = [*(["--quick"] if args.quick else []), *args.options]
    output = _output(scripts[args.name], options)
    if {"-h", "--help"} & set(options):
        print(output, end="")
        return 0
    result = json.loads(output)
    if args.json:
        console.emit(result)
        return 0
    said = {True: "yes", False: "no", None: None}
    rows = [[f["name"], f["value"], f["unit"], f["target"], said[f["met"]]] for f in result["figures"]]
    console.table(result["name"], ["figure", "value", "unit", "target", "met"], rows)
    return 0


def _list(scripts: dict[str, Path], as_json: bool) -> None:
    sources = {name: path / "__main__.py" if path.is_dir() else path for name, path in scripts.items()}
    about = {name: _summary(path) for name, path in sources.items()}
    if as_json:
        console.emit({"benchmarks": list(about), "about": about})
        return
    for name, text in about.items():
        print(f"  {name:16} {text}")
    print("./tcbi bench NAME runs one, with --quick a short one; docs/benchmarks.md has their figures and targets.")


def _summary(script: Path) -> str:
    """What a benchmark's docstring says first."""
    told = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    return " ".join(told.partition("\n\n")[0].split())


def figure(name: str, value: float, unit: str, least: float | None = None, most: float | None = None) -> dict[str, Any]:
    """One of the figures that a benchmark prints, beside its target: at least, at most, or a range."""
    bounds = [bound for bound in (least, most) if bound is not None]
    met = None
    if bounds and not math.isnan(value):
        met = bool((least is None or value >= least) and (most is None or value <= most))
    return {
        "name": name,
        "value": round(float(value), 3) if math.isfinite(value) else None,
        "unit": unit,
        "target": " to ".join(f"{bound:g}" for bound in bounds) if len(bounds) > 1 else next(iter(bounds), None),
        "met": met,
    }


def _output(script: Path, options: list[str]) -> str:
    done = subprocess.run([sys.executable, str(script), *options], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise BringupError(f"{script.name} ended with status {done.returncode}; its last words are above")
    return done.stdout
