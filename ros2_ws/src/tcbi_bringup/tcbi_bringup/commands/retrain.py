"""`./tcbi retrain`: train the successor of a policy on a model's posterior, and keep it if it is better."""

import argparse
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import above, at_least, seed
from tcbi_bringup.commands import console

SUMMARY = "Train a policy's successor on a model's posterior; it is kept only if it is better with confidence."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which policy, on which model, and for how long."""
    console.add_task(parser, required=True)
    parser.add_argument(
        "--policy",
        default="",
        help="the policy to beat, and to start from if it is for this task (default: the newest)",
    )
    parser.add_argument("--scratch", action="store_true", help="train from scratch instead of from that policy")
    console.add_model(parser, "model version whose posterior is drawn from")
    parser.add_argument("--seed", type=seed, default=0, help="of everything that is drawn (default: 0)")
    parser.add_argument(
        "--steps",
        type=at_least(1),
        default=0,
        help="control steps of all simulations together (default: some 57600)",
    )
    parser.add_argument(
        "--budget", type=above(0.0), default=0.0, metavar="SECONDS",
        help="train for this time instead of for the preset's steps; start-up, the evaluation at the end "
        "and the comparison come on top; with --steps, for whichever is over first",
    )  # fmt: skip
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi retrain --task balance",
        "./tcbi retrain --task balance --model hexapod-v2 --policy balance-1 --budget 120 --json",
    )


def run(args: argparse.Namespace) -> int:
    """Train, compare, keep."""
    from tcbi_bringup.commands.train import follow
    from tcbi_policy.retraining import SCRATCH, Job, plan, retrain
    from tcbi_sim.store import ModelStore

    root = ModelStore(args.store).root
    current = args.policy or _newest(args.task, root)
    start = SCRATCH if args.scratch else ""
    job = Job(args.task, current, start, args.model, root, args.budget, args.steps, args.seed)
    planned = plan(job)
    console.note_model(args.model, planned.model)
    begins = f"from {planned.start}" if planned.start else "from scratch"
    console.note(f"training {begins} against {current} on {planned.model}; interrupted, the same command goes on")
    with console.progress("training", total=1.0) as advance:
        outcome = retrain(job, lambda event: follow(event, advance))
    result: dict[str, Any] = {
        "accepted": outcome.accepted, "policy": outcome.path, "name": outcome.reference, "rival": current,
        "task": args.task, "model": planned.model,
        "return_before": outcome.return_before, "return_after": outcome.return_after,
        "message": outcome.message,
    }  # fmt: skip
    if args.json:
        console.emit(result)
    else:
        print(f"{outcome.reference}: {outcome.message}" if outcome.reference else outcome.message)
    return 0


def _newest(task: str, root: Path) -> str:
    """The newest policy for a task; notes name those that cannot be read."""
    from tcbi_policy.artefact import newest_policy
    from tcbi_sim.tasks import find_task

    name, faults = newest_policy(find_task(task).name, root)
    for fault in faults:
        console.note(f"left out: {fault}")
    return name
