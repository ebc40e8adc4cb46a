"""`./tcbi study`: the paper's experiment on emulated robots."""

import argparse
import json
import os
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import at_least, folder_path, not_empty
from tcbi_bringup.commands import console

SUMMARY = (
    "Does it transfer? Collect, infer by each method, retrain and deploy on emulated robots; what is done is kept."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How much, and of what."""
    parser.add_argument("--preset", default="hour", help="hour (on two cores; default) or full (days)")
    parser.add_argument(
        "--robots", type=not_empty, metavar="N,N", help="numbers of emulated robots (default: the preset's)"
    )
    parser.add_argument("--tasks", type=not_empty, help="balance, forward, or both with a comma (default: both)")
    parser.add_argument(
        "--methods",
        type=not_empty,
        metavar="NAME,NAME",
        help="of fixed_dr, abc, simopt, bayesopt, tcbi_reward, tcbi_paper, tcbi, tcbi_effect (default: the preset's); "
        "bayesopt needs Optuna (docs/study.md) and is left out without it",
    )
    parser.add_argument("--out", type=folder_path, help="folder of the study (default: study-PRESET in the store)")
    parser.add_argument(
        "--report",
        action="store_true",
        help="only write the tables of what is there already, whichever robots, tasks and methods",
    )
    parser.add_argument("--threads", type=at_least(0), default=0, help="0 (default) for all processors")
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi study                                  # an hour on two cores; interrupted, the same command goes on",
        "./tcbi study --tasks balance --robots 11 --methods fixed_dr,tcbi,tcbi_effect",
        "./tcbi study --preset full --out study        # days; the report can be looked at meanwhile:",
        "./tcbi study --preset full --out study --report",
    )


def run(args: argparse.Namespace) -> int:
    """Go on with the study, and write what there is."""
    from tcbi_bringup.study.experiment import Experiment, asked, check_report
    from tcbi_bringup.study.notebook import Notebook, hold
    from tcbi_bringup.study.plan import chosen, of_what_is_there
    from tcbi_bringup.study.robots import Laboratory

    names = [given or "" for given in (args.robots, args.tasks, args.methods)]
    plan = chosen(args.preset, *names)
    folder = (args.out or console.store_folder(args.store) / f"study-{args.preset}").expanduser().absolute()
    if args.report:
        check_report(plan, folder)
        there = Notebook(folder / "study.jsonl").keys()
        plan = of_what_is_there(plan, there, names, asked(folder))
        data = _report(args.preset, plan, folder)
    else:
        threads = args.threads or len(os.sched_getaffinity(0))
        with hold(folder), Laboratory(threads) as laboratory:
            experiment = Experiment(plan, folder, laboratory, threads)
            try:
                _work(experiment)
            except KeyboardInterrupt:
                console.note("stopping; the same command goes on")
                raise
            finally:
                data = _report(args.preset, plan, folder)
    if args.json:
        console.emit(data)
    else:
        _print(data)
    return 0


def _report(preset: str, plan: Any, folder: Path) -> dict[str, Any]:
    """Write what the study has found so far; returns it."""
    from tcbi_bringup.study import tables
    from tcbi_bringup.study.notebook import Notebook
    from tcbi_bringup.study.page import write
    from tcbi_contract.files import replace_file

    findings = tables.Findings(plan, Notebook(folder / "study.jsonl"))
    data = {"preset": preset, "folder": str(folder), **tables.everything(findings)}
    replace_file(folder / "study.json", (json.dumps(console.plain(data), indent=1) + "\n").encode())
    return data | {"report": str(write(findings, folder / "study.html"))}


def _work(experiment: Any) -> None:
    """All pieces; those of an earlier run are only counted."""
    from tcbi_bringup.study.plan import cost

    pieces = list(experiment.plan.pieces())
    told: set[str] = set()
    left = [piece for piece in pieces if piece not in experiment.notebook]
    console.note(f"{len(pieces)} pieces of work, {len(pieces) - len(left)} of them done, in {experiment.folder}")
    costs = [cost(piece) for piece in left]
    with console.progress("study", total=sum(costs)) as advance:
        for number, piece in enumerate(left):
            advance(done=sum(costs[:number]), note=f"{' '.join(map(str, piece))} ({number + 1} of {len(left)})")
            why = experiment.do(piece).get("left_out")
            if why and why not in told:
                told.add(why)
                console.note(f"{' '.join(map(str, piece))} left out: {why}")


def _print(data: dict[str, Any]) -> None:
    from tcbi_bringup.study.page import range_of
    from tcbi_contract.wording import counted

    for task, found in data["tasks"].items():
        rows = [
            [r["label"], r["return"], r["return_sd"], range_of(r, "return"),
             r["inclination_deg"], r["distance_cm"], r["divergence_nats"], r["rollouts"]]
            for r in found["performance"]
        ]  # fmt: skip
        head = ["retrained on", "return", "sd", "95 %", "inclination / deg", "distance / cm", "divergence", "rollouts"]
        console.table(f"{task}, on {counted(len(data['robots']), 'robot')}", head, rows)
        rows = [
            [
                r["label"],
                r.get("gain_returns"),
                range_of(r, "gain_returns"),
                r.get("p_returns"),
                r.get("p_returns_holm"),
                r.get("p_divergence"),
            ]
            for r in found["comparisons"]
        ]
        if rows:
            console.table(
                "TCBI against", ["", "gain in return", "95 %", "p (Welch)", "p (Holm)", "p, divergence"], rows
            )
        rows = [
            [r["label"], r["parameter"], f"{r['variance_reduction']:z.0%}", f"{r['relative_error']:.0%}",
             f"{r['truth_in_90']} of {r['robots']}"]
            for r in found["variance_reduction"]
        ]  # fmt: skip
        head = ["method", "parameter", "variance less than prior", "error of the mean", "truth inside 90 %"]
        console.table(f"{task}, inference", head, rows)
        if effect := found["effect"]:
            where = counted(effect["robots"], "robot")
            print(
                f"with the diagnosed effect in the model {effect['with']:.0f}, without {effect['without']:.0f}, "
                f"a gain of {effect['gain']:.0f} (95 %: {range_of(effect, 'gain')}) on {where}"
            )
    for line in data["notes"]:
        print(line)
    print(data["took"])
    print(f"report: {data['report']}")
