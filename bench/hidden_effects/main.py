"""Robots with something hidden in them: is it found, is nothing found where nothing is, and how sure may one be?

./tcbi bench hidden --quick                                              # one robot of each of seven kinds
./tcbi bench hidden -- --plan bench --hidden all --strength strong,weak --seeds 400:405 --keep all.jsonl
./tcbi bench hidden -- --plan bench --hidden none --seeds 300:400 --keep none.jsonl
./tcbi bench hidden -- --judge --keep judged.jsonl                        # on robots that nothing was chosen on
./tcbi bench hidden -- --plan bench --hidden none --outside --pairs --seeds 400:403 --keep more.jsonl

Each robot is an emulated one (its own physics; docs/emulated_robot.md), recorded and diagnosed in process and faster
than real time. `--keep FILE` holds one JSON line for each robot; what is there already is not run again, so a stopped
run goes on, and a file of a finished run gives the figures at once.
"""

import argparse
import itertools
import json
import sys
from pathlib import Path

from hidden_effects.figures import figures
from hidden_effects.outcomes import as_text, confusion, outcome
from hidden_effects.robots import PLANS, Job, Result, results
from tcbi_bringup.emulated_robot.hidden_names import DRAWN, LIBRARY, NONE, OUTSIDE, STRENGTHS, hidden
from tcbi_bringup.errors import BringupError

SETS = {"six": (NONE, *DRAWN), "all": (NONE, *LIBRARY)}
JUDGED, JUDGED_EMPTY = range(2000, 2005), range(2000, 2100)  # robots that nothing was ever chosen on
PAIRED = (*DRAWN, "command_deadband", "imu_tilt", "rotor_inertia", "torque_saturation")


def main() -> int:
    """Measure and print."""
    options = parser().parse_args()
    try:
        found = list(results(jobs_of(options), options.keep, options.workers, progress))
    except BringupError as error:
        print(error, file=sys.stderr)
        return 1
    table = confusion(found)
    print(as_text(table), file=sys.stderr)
    print(json.dumps({"name": "hidden", "figures": figures(found), "confusion": table}, indent=2))
    return 0


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--quick", action="store_true", help="one robot of each kind, quick diagnosis")
    p.add_argument("--plan", choices=PLANS, default="quick", help="what is recorded and tried (default: quick)")
    p.add_argument(
        "--hidden",
        type=kinds,
        default="six",
        help="all, six (default), or effects and none, with commas; a+b for two in a robot",
    )
    p.add_argument("--pairs", action="store_true", help=f"all pairs of {len(PAIRED)} effects, too")
    p.add_argument("--outside", action="store_true", help=f"the {len(OUTSIDE)} effects outside the library, too")
    p.add_argument("--strength", type=strengths, default=STRENGTHS[0], help="strong (default), weak, or both by comma")
    p.add_argument(
        "--judge",
        action="store_true",
        help=f"robots {JUDGED[0]} to {JUDGED[-1]} with each effect at both strengths, {JUDGED_EMPTY[0]} to "
        f"{JUDGED_EMPTY[-1]} with nothing, in place of --seeds and --strength: look, and change nothing for them",
    )
    p.add_argument("--seeds", type=seeds, default="200:203", help="first:end of the robots' numbers (default: 200:203)")
    p.add_argument("--keep", type=Path, help="file of results, one JSON object a line")
    p.add_argument("--workers", type=int, default=2)
    return p


def kinds(text: str) -> list[str]:
    """What robots hide: a set's name, or names with commas."""
    return list(SETS.get(text) or [hidden(name) for name in text.split(",")])


def strengths(text: str) -> list[str]:
    """Known strengths, with commas."""
    if wrong := [name for name in text.split(",") if name not in STRENGTHS]:
        raise argparse.ArgumentTypeError(f"unknown strength {wrong[0]!r}; there are {', '.join(STRENGTHS)}")
    return text.split(",")


def seeds(text: str) -> range:
    """first:end."""
    first, _, end = text.partition(":")
    if not (first.isdigit() and end.isdigit() and int(first) < int(end)):
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted first:end, as in 200:203")
    return range(int(first), int(end))


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """The robots asked for, all kinds of one number before those of the next."""
    wanted = list(options.hidden)
    if options.pairs:
        wanted += ["+".join(pair) for pair in itertools.combinations(PAIRED, 2)]
    if options.outside:
        wanted += OUTSIDE
    plan = "quick" if options.quick else options.plan
    numbers = JUDGED if options.judge else options.seeds[:1] if options.quick else options.seeds
    strong_and_weak = STRENGTHS if options.judge else options.strength
    jobs = [
        (plan, kind, strength, seed)
        for seed in numbers
        for kind in dict.fromkeys(wanted)
        for strength in (strong_and_weak if kind != NONE else STRENGTHS[:1])
    ]
    if options.judge and NONE in wanted:
        jobs += [(plan, NONE, STRENGTHS[0], seed) for seed in JUDGED_EMPTY if seed not in JUDGED]
    return jobs


def progress(done: int, count: int, left_s: float, result: Result) -> None:
    """A line for each robot."""
    line = f"{result['hidden']} ({result['strength']}) seed {result['seed']}: {outcome(result)}; {result['statement']}"
    print(f"{done}/{count}, {left_s:.0f} s left; {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
