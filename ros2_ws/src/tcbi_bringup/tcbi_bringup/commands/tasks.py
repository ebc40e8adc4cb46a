"""`./tcbi tasks`: what a robot can be asked to do, one of the tasks, or what is wrong with a file of one's own."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import USAGE
from tcbi_bringup.commands import console

if TYPE_CHECKING:
    from tcbi_sim.tasks import Task

SUMMARY = "List the tasks with their rewards, show what one draws, or check a task of your own."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi tasks                                 # duration, ground, reward with its units",
        "./tcbi tasks show forward                    # each term of the reward, and what scenarios are like",
        "./tcbi tasks check turn.py                   # what is wrong with it, each fault in a line",
        "cp turn.py ~/.local/share/tcbi/tasks/ && ./tcbi train --task turn",
    )
    parser.add_argument("action", nargs="?", choices=("list", "show", "check"), default="list", help="default: list")
    parser.add_argument("name", nargs="?", metavar="NAME|FILE", help="a task to show, or a file to check")
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List, show or check."""
    if (args.name is None) != (args.action == "list"):
        console.note(f"tcbi: usage: ./tcbi tasks {'list' if args.action == 'list' else args.action + ' NAME|FILE'}")
        return USAGE
    if args.action == "check":
        return _check(Path(args.name), args)
    return _show(args.name, args) if args.action == "show" else _list(args)


def _list(args: argparse.Namespace) -> int:
    from tcbi_policy.reward import formula
    from tcbi_sim.tasks import tasks, tasks_folder

    every = list(tasks().values())
    if args.json:
        console.emit({"tasks": [_as_json(task) for task in every], "folder": str(tasks_folder())})
        return 0
    rows = [[task.name, task.description, task.duration, task.blocks] for task in every]
    console.table("", ["task", "what", "duration / s", "blocks at most"], rows)
    for task in every:
        print(f"{task.name}: {formula(task.name)}")
    print("x: progress / m, e: (|roll| + |pitch|) / 2 / rad, a: joint targets / rad; ' is the end of the control step")
    print(f"your own: one file each in {tasks_folder()} (docs/policies.md)")
    return 0


def _show(name: str, args: argparse.Namespace) -> int:
    from tcbi_policy.reward import formula, terms_of
    from tcbi_sim.tasks import drawn, find_task

    task = find_task(name)
    if args.json:
        console.emit({**_as_json(task), "scenarios": [d._asdict() for d in drawn(task)]})
        return 0
    print(f"{task.name}: {task.description}, {task.duration:g} s")
    print(f"{formula(name)}, each control step")
    terms = [[t.name, f"{t.weight:g}", t.unit, t.formula] for t in terms_of(name)]
    console.table("", ["term", "weight", "per", "of"], terms)
    rows = [[d.what, d.unit, *(f"{round(x, 3) + 0.0:g}" for x in (d.low, d.median, d.high))] for d in drawn(task)]
    console.table("400 scenarios drawn", ["", "unit", "least", "median", "most"], rows)
    return 0


def _as_json(task: "Task") -> dict[str, Any]:
    from tcbi_policy.reward import formula, terms_of

    keys = ("name", "weight", "unit", "formula")
    return {
        "task": task.name, "description": task.description, "duration_s": task.duration, "blocks": task.blocks,
        "reward": formula(task.name), "terms": [{k: getattr(t, k) for k in keys} for t in terms_of(task.name)],
    }  # fmt: skip


def _check(path: Path, args: argparse.Namespace) -> int:
    from tcbi_policy.task_check import check_file_apart

    with console.progress(f"trying {path.name}"):
        task, faults = check_file_apart(path)
    if args.json:
        console.emit({"file": str(path), "task": task, "faults": faults})
    else:
        for fault in faults:
            print(f"{path}: {fault}")
        if not faults:
            print(f"{path}: task {task} is fit for use; copy it to the folder that ./tcbi tasks names")
    return 1 if faults else 0
