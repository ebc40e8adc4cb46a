"""Do posteriors hold the truth, and how near do they come? TCBI beside every method it is compared with.

./tcbi python bench/calibration --quick
./tcbi python bench/calibration --source model --task balance --methods calibrated --truths 0:100 --keep runs.jsonl
./tcbi python bench/calibration --source robot --methods all --truths 0:20 --keep runs.jsonl
./tcbi python bench/calibration --methods paper@50x15,calibrated@50x3 --truths 0:20 --keep budgets.jsonl
./tcbi python bench/calibration --noise 0,0.02,0.04,0.08 --methods calibrated --truths 0:20 --keep noise.jsonl
./tcbi python bench/calibration --methods calibrated,simopt --loop open --truths 0:20 --keep replayed.jsonl
./tcbi python bench/calibration --figures runs.jsonl            # of what was kept; nothing is run

A truth is recorded. Source `model`: drawn from the prior, simulated with finer steps and sensor noise. Source `robot`:
an emulated robot, another implementation with its own contacts and friction. Source `hidden`: one with an effect that
the model lacks, which an inference must say. Every method infers a truth from the same rollouts with the same number of
simulations, unless METHOD@PARTICLESxGENERATIONS says otherwise. `--keep FILE` holds one JSON line for each inference;
what is there already of the same code is not run again, so a stopped run goes on.
"""

import argparse
import functools
import itertools
import json
import multiprocessing
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from figures import figures
from jobs import CODE, Case, Result, run
from truths import POLICIES

from tcbi_infer.divergence import LEAST_BINS
from tcbi_infer.tcbi.loop import LOOPS
from tcbi_infer.tcbi.method import METHODS

SOURCES = ("model", "robot", "hidden")
QUICK = {
    "methods": "calibrated,prior",
    "truths": "0:2",
    "rollouts": 8,
    "particles": 16,
    "generations": 3,
    "duration": 2,
}


def cases(options: argparse.Namespace) -> list[Case]:
    """All that is asked for, truth by truth, so that each is recorded once."""
    truths = re.fullmatch(r"(\d+):(\d+)", options.truths)
    if truths is None:
        raise SystemExit(f"--truths {options.truths}: allowed is FIRST:END, such as 0:100")
    first, end = int(truths[1]), int(truths[2])
    for option, given, allowed in (("source", options.source, SOURCES), ("task", options.task, tuple(POLICIES))):
        unknown = [name for name in given.split(",") if name not in allowed]
        if unknown:
            raise SystemExit(f"--{option} {unknown[0]}: allowed is {', '.join(allowed)}")
    methods = [_asked(text, options) for text in (METHODS if options.methods == "all" else options.methods.split(","))]
    noises = [float(x) for x in options.noise.split(",")]
    return [
        Case(
            source, task, truth, method, noise, options.rollouts, options.duration, particles, generations,
            options.bins, settings, options.loop,
        )
        for source, task, truth, noise, (method, particles, generations, settings) in itertools.product(
            options.source.split(","), options.task.split(","), range(first, end), noises, methods
        )
    ]  # fmt: skip


def _asked(text: str, options: argparse.Namespace) -> tuple[str, int, int, tuple[tuple[str, float], ...]]:
    """Of METHOD or METHOD@PARTICLESxGENERATIONS: its name, its budget and those of the settings that it has."""
    name, _, budget = text.partition("@")
    wanted = re.fullmatch(r"(\d+)x(\d+)", budget or f"{options.particles}x{options.generations}")
    if name not in METHODS or wanted is None:
        raise SystemExit(f"--methods {text}: allowed is METHOD or METHOD@50x6, of {', '.join(METHODS)}")
    pairs = [re.fullmatch(r"(\w+)=([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)", pair) for pair in options.set]
    if None in pairs:
        raise SystemExit(f"--set {options.set[pairs.index(None)]}: allowed is NAME=NUMBER, such as alpha=0.1")
    settings = {pair[1]: float(pair[2]) for pair in pairs if pair}
    unknown = sorted(set(settings) - {field for method in METHODS.values() for field in method.settings._fields})
    if unknown:
        raise SystemExit(f"--set {unknown[0]}: no method has such a setting")
    lacking = sorted(set(settings) - set(METHODS[name].settings._fields))
    if lacking:
        print(f"{name} has no setting {', '.join(lacking)}, and runs without", file=sys.stderr)
    own = tuple(sorted((key, value) for key, value in settings.items() if key not in lacking))
    return name, int(wanted[1]), int(wanted[2]), own


def kept(path: Path | None) -> list[Result]:
    """What an earlier run left; a last line that was cut off is dropped."""
    found: list[Result] = []
    for line in path.read_text().splitlines() if path and path.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            print(f"{path}: a line that was cut off is left out", file=sys.stderr)
    return found


def of_code(found: list[Result], code: str) -> list[Result]:
    """Those of one code; what other code found may be something else."""
    same = [r for r in found if r.get("code") == code]
    if len(same) < len(found):
        print(f"{len(found) - len(same)} results of other code are left out", file=sys.stderr)
    return same


def results(wanted: list[Case], keep: Path | None, workers: int) -> Iterator[Result]:
    """Of all cases, those kept from an earlier run first."""
    done = {json.dumps(r["case"], sort_keys=True): r for r in of_code(kept(keep), CODE)}
    left = []
    for case in wanted:
        old = done.get(case.key())
        if old is None:
            left.append(case)
        else:
            yield old
    began = time.monotonic()
    for i, result in enumerate(_run_all(left, workers), 1):
        if keep:
            torn = keep.exists() and not keep.read_bytes().endswith(b"\n")
            with keep.open("a") as file:
                file.write("\n" * torn + json.dumps(result) + "\n")
        rest = (time.monotonic() - began) / i * (len(left) - i)
        case = result["case"]
        what = f"{case['source']} {case['task']} truth {case['truth']}, {case['method']}"
        print(f"{i}/{len(left)}, {rest:.0f} s left; {what}: {result['cpu_s']:.1f} s", file=sys.stderr, flush=True)
        yield result


def _run_all(left: list[Case], workers: int) -> Iterator[Result]:
    if workers == 1:
        yield from map(run, left)
        return
    shared = functools.partial(run, threads=max(1, len(os.sched_getaffinity(0)) // workers))
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(shared, left, chunksize=1)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two truths of each task, two methods, short rollouts")
    parser.add_argument("--source", default="model", help="model, robot, hidden; with commas")
    parser.add_argument("--task", default="balance,forward", help="with commas")
    parser.add_argument(
        "--methods", default="calibrated", help="with commas, or all; METHOD@50x6 has a budget of its own"
    )
    parser.add_argument("--truths", default="0:100", help="first:end of their numbers")
    parser.add_argument("--noise", default="0", help="sigma of equation 14 in rad, added to what was recorded; commas")
    parser.add_argument("--rollouts", type=int, default=20)
    parser.add_argument("--duration", type=float, default=8.0, help="of each rollout, s")
    parser.add_argument("--particles", type=int, default=50)
    parser.add_argument("--generations", type=int, default=6)
    parser.add_argument("--bins", type=int, default=20)
    parser.add_argument("--loop", choices=LOOPS, default="", help="as of ./tcbi infer (default: the method's)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="of the methods that have such a setting"
    )
    parser.add_argument("--keep", type=Path, help="file of results, one JSON object a line")
    parser.add_argument("--figures", type=Path, metavar="FILE", help="only print what this file of results says")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    if options.quick:
        vars(options).update(QUICK)
    if options.rollouts < 2:
        raise SystemExit(f"--rollouts {options.rollouts}: allowed is 2 or more, one of each of two policies")
    if options.bins < LEAST_BINS:
        raise SystemExit(f"--bins {options.bins}: allowed is {LEAST_BINS} or more, two of them tails")
    if options.figures:
        there = kept(options.figures)
        found = of_code(there, there[-1].get("code", "") if there else "")
    else:
        found = list(results(cases(options), options.keep, options.workers))
    print(json.dumps({"name": "calibration", "figures": figures(found)}, indent=2))
    return 0
