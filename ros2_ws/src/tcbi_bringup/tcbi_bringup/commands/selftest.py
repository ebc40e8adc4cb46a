"""`./tcbi selftest`: plants known effects in the user's own model, and says which of them a diagnosis would find."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import at_least
from tcbi_bringup.commands import console
from tcbi_bringup.errors import WrongCallError
from tcbi_contract.errors import describe

if TYPE_CHECKING:
    from tcbi_infer.selftest import Bench, Robot, Summary
    from tcbi_sim.model import Model

SUMMARY = "Plant known effects in a model, with another solver and step, and report what a diagnosis would find."
STRENGTHS = ("strong", "weak", "both")
OK, NOT_PASSED, INTERRUPTED = 0, 1, 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi selftest --model hexapod-v0 --effects backlash,coulomb_friction",
        "./tcbi selftest --model hexapod-v2 --rollouts rollouts/* --keep selftest.jsonl    # with your own motions",
        "./tcbi selftest --model servo_bench-v0 --seeds 3 --strength both --json           # for your CI",
    )
    console.add_model(parser)
    parser.add_argument("--rig", default="hexapod", help="whose newest model, where none is named (default: hexapod)")
    parser.add_argument("--effects", help="comma-separated effects to plant (default: all that are tried)")
    parser.add_argument(
        "--candidates", help="comma-separated effects that each diagnosis tries (default: as `diagnose` does)"
    )
    parser.add_argument("--strength", choices=STRENGTHS, default=STRENGTHS[0], help="of the effects (default: strong)")
    parser.add_argument(
        "--seeds", type=at_least(1), default=1, metavar="N", help="robots of each kind, and with nothing (default: 1)"
    )
    parser.add_argument(
        "--rollouts", nargs="+", type=Path, metavar="BAG", help="bags whose commands are played (default: own motions)"
    )
    parser.add_argument(
        "--duration",
        type=at_least(1.0),
        default=3.0,
        metavar="S",
        help="of a motion where no bags are given (default: 3)",
    )
    parser.add_argument("--full", action="store_true", help="diagnose thoroughly, not as `diagnose --quick`")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="file of results; what is there is not run again")
    parser.add_argument(
        "--most-missed",
        type=at_least(0),
        default=0,
        metavar="N",
        help="strong effects that may be missed, weak ones with --strength weak (default: 0)",
    )
    parser.add_argument(
        "--most-false-alarms", type=at_least(0), default=0, metavar="N", help="that may be raised (default: 0)"
    )
    parser.add_argument("--certain", action="store_true", help='"cannot tell" that names the effect counts as missed')
    console.add_workers(parser)
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Record and diagnose one robot after another; status 1 if too much was missed or a false alarm was raised."""
    from tcbi_infer.selftest import Limits, summarise, trials

    bench, planned = _plan(args)
    results: list[dict[str, Any]] = []
    stopped = False
    with console.progress("self-test", total=len(planned), unit="robots") as advance:

        def tell(robot: "Robot", stage: str, share: float) -> None:
            advance(done=round(len(results) + min(share, 0.99), 2), note=f"{robot.use or 'nothing planted'}, {stage}")

        try:
            for result in trials(bench, planned, args.keep, tell):
                results.append(result)
                advance(done=len(results))
        except KeyboardInterrupt:
            stopped = True
    summary = summarise(results, Limits(args.most_missed, args.most_false_alarms, not args.certain))
    left_out = _not_planted(bench.model, planned)
    if args.json:
        passed = summary.passed and not stopped
        answer = {**summary.to_json(), "passed": passed, "stopped": stopped, "robots": results}
        console.emit({"model": bench.model.version, **answer, "not_planted": left_out})
    else:
        _print(bench.model, results, summary, stopped)
        if left_out:
            print(f"Not planted, so nothing is said of them: {', '.join(left_out)}")
    if stopped:
        rest = "the same command goes on from there" if args.keep else "--keep FILE would let it go on later"
        console.note(f"stopped after {len(results)} of {len(planned)} robots; {rest}")
        return INTERRUPTED
    return OK if summary.passed else NOT_PASSED


def _plan(args: argparse.Namespace) -> tuple["Bench", list["Robot"]]:
    """What is tried, and on which robots."""
    from tcbi_infer.bags.reader import read_measurements
    from tcbi_infer.diagnose.at_random import at_random
    from tcbi_infer.diagnose.candidates import find_candidates, tried
    from tcbi_infer.diagnose.motions import standard_motions
    from tcbi_infer.diagnose.settings import QUICK, Settings
    from tcbi_infer.selftest import STRENGTHS as SIZES
    from tcbi_infer.selftest import Bench, robots
    from tcbi_infer.selftest.trial import motions_of
    from tcbi_sim.rigs import load_rig
    from tcbi_sim.store import ModelStore

    rollouts = read_measurements(args.rollouts) if args.rollouts else []
    model = console.load_model(ModelStore(args.store), args.model, rollouts[0].rig if rollouts else args.rig)
    rig = load_rig(model.rig)
    if any(m.rig != model.rig for m in rollouts):
        from tcbi_infer.compare.errors import WrongRigError

        other = next(m for m in rollouts if m.rig != model.rig)
        raise WrongRigError(model.version, model.rig, other.rig, other.joint_names)
    settings = Settings() if args.full else QUICK
    keys = find_candidates(model, args.candidates.split(",")) if args.candidates else tried(model, settings)
    candidates = tuple(keys)
    # what is random only a robot that does not repeat itself shows
    told = [use for use in candidates if not at_random(model, use)]
    planted = find_candidates(model, args.effects.split(",")) if args.effects else told
    _refuse_untried(planted, candidates)
    strengths = list(SIZES) if args.strength == "both" else [args.strength]
    motions = motions_of(rollouts) if rollouts else tuple(standard_motions(rig, args.duration))
    bench = Bench(model, motions, settings, candidates)
    return bench, robots([use for use in planted if use in candidates], strengths, args.seeds)


def _not_planted(model: "Model", planned: Sequence["Robot"]) -> list[str]:
    """The library's effects that this rig can have and no robot has."""
    from tcbi_infer.diagnose.candidates import tried
    from tcbi_infer.diagnose.settings import Settings

    known = {use.partition(":")[0] for use in tried(model, Settings())}
    return sorted(known - {robot.use.partition(":")[0] for robot in planned})


def _refuse_untried(planted: Sequence[str], candidates: Sequence[str]) -> None:
    """Refuse effects of which no diagnosis would try a single use: a robot with one could only be missed.

    Raises:
      WrongCallError: there are some.
    """
    names = [sorted({use.partition(":")[0] for use in uses}) for uses in (planted, candidates)]
    untried = [name for name in names[0] if name not in names[1]]
    if untried:
        raise WrongCallError(
            describe("effects to plant", ", ".join(untried), "those that a diagnosis tries: " + ", ".join(names[1]))
            + "; --full tries every joint, --candidates names others"
        )


def _print(model: "Model", results: list[dict[str, Any]], summary: "Summary", stopped: bool) -> None:
    rows = []
    for r in results:
        sizes = "; ".join(f"{name.rpartition('.')[2]} {value:.3g}" for name, value in r["planted"].items())
        said = r["verdict"] + (f": {', '.join(r['uses'])}" if r["uses"] else "")
        rows.append(
            [r["use"] or "nothing", r["strength"], sizes, r["outcome"], said, r["error_before"], r["error_after"]]
        )
    head = ["planted", "strength", "size", "outcome", "verdict", "error before", "after"]
    console.table(f"{model.version}: what a diagnosis finds", head, rows)
    print(summary.claim)
    for fault in summary.faults:
        print(f"not passed: {fault}")
    if summary.passed and not stopped:
        print("passed")
