"""`./tcbi demo`: the whole loop on an emulated robot with a hidden effect."""

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import at_least, folder_path
from tcbi_bringup.commands import console

if TYPE_CHECKING:
    from tcbi_bringup.demo.story import Outcome
    from tcbi_infer.report import Section

SUMMARY = "The whole story on an emulated robot: record, compare, diagnose, add, infer, retrain, measure again."
NICENESS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which robot, and how long the story may take."""
    parser.add_argument("--seed", type=at_least(0), default=1, help="number of the robot (default: 1)")
    console.add_hidden(parser, strength="strong")
    parser.add_argument(
        "--quick", action="store_true", help="a shorter story: fewer motions, six effects, little training"
    )
    parser.add_argument("--folder", type=folder_path, help="where everything goes (default: a new folder in the store)")
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi demo                              # some hidden effect, about six minutes on two cores",
        "./tcbi demo --quick --hidden backlash",
        "./tcbi demo --hidden none                # should end in: nothing is missing",
        "./tcbi demo --seed 7 --json > demo.json",
    )


def run(args: argparse.Namespace) -> int:
    """Tell the story, print the table, name the report."""
    from tcbi_bringup.demo.robot import Robot, running
    from tcbi_sim.store import ModelStore

    robot = Robot(args.seed, args.hidden, args.strength)
    folder = args.folder or ModelStore(args.store).folder("demo") / time.strftime("%Y%m%d-%H%M%S")
    folder = folder.expanduser().resolve()
    folder.mkdir(parents=True, exist_ok=True)
    console.note(f"everything goes to {folder}")
    with running(robot, folder, folder / "store") as (lab, graph), ThreadPoolExecutor(1) as beside:
        os.nice(NICENESS)  # the robot moves in real time, whatever is loaded and computed beside it
        from tcbi_bringup.demo.plan import FULL, QUICK  # seconds of imports, while the nodes start
        from tcbi_bringup.demo.story import Story

        lab.wait(graph.check_briefly)
        beside.submit(_load_the_rest)
        drawn: list[Section] = []
        outcome = Story(robot, QUICK if args.quick else FULL, folder, lab).tell(lambda out: drawn.extend(_draw(out)))
        beside.submit(graph.stop)  # seconds, too
        from tcbi_bringup.demo import page
        from tcbi_bringup.emulated_robot.physics import Specimen

        truth = Specimen.of(args.seed, args.hidden or None, args.strength).truth()
        report = page.write(outcome, drawn, truth, folder / "report.html")
    if args.json:
        console.emit(as_json(outcome, truth, report))
    else:
        _print(outcome, truth, report)
    return 0


def _draw(outcome: "Outcome") -> "list[Section]":
    from tcbi_bringup.demo.page import findings

    return findings(outcome)


def _load_the_rest() -> None:
    """Seconds of imports, while the robot moves."""
    import xarray  # noqa: F401

    import tcbi_bringup.demo.page  # noqa: F401


def as_json(outcome: "Outcome", truth: dict[str, Any], report: Path) -> dict[str, Any]:
    """The contract's object, and what is hidden in full."""
    from tcbi_bringup.demo.story import mean_return

    return {
        "hidden": truth["hidden"],
        "verdict": outcome.verdict,
        "effects": outcome.effects,
        "steps": outcome.narration.steps,
        "models": _models(outcome),
        "return_before": mean_return(outcome.before),
        "return_after": mean_return(outcome.after),
        "report": report,
        "truth": truth,
        "seconds": sum(step["seconds"] for step in outcome.narration.steps),
    }


def _models(outcome: "Outcome") -> list[dict[str, Any]]:
    return [
        {
            "model": m.version,
            "parent": m.parent,
            "effects": list(m.effects),
            "error_over_floor": outcome.errors[m.version].error_over_floor,
        }
        for m in outcome.models
    ]


def _print(outcome: "Outcome", truth: dict[str, Any], report: Path) -> None:
    from tcbi_bringup.demo.story import mean_return, tilt

    rows: list[list[Any]] = []
    models = _models(outcome)
    for i, m in enumerate(models):
        deployed = {0: outcome.before, len(models) - 1: outcome.after}.get(i)
        returns = [mean_return(deployed), tilt(deployed)] if deployed else [None, None]
        rows.append([m["model"], ", ".join(m["effects"]) or "none", m["error_over_floor"], *returns])
    columns = ["model", "effects", "error / noise floor", "return on the robot", "final inclination / deg"]
    console.table("", columns, rows)
    sizes = [f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in truth["effect"].items()]
    print(f"verdict: {outcome.diagnoses[0].headline} ({', '.join(outcome.effects) or 'none added'})")
    print(f"hidden in the robot: {truth['hidden']}{' (' + ', '.join(sizes) + ')' if sizes else ''}")
    print(f"report: {report}")
