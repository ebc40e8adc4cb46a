"""`./tcbi tasks`: what a robot can be asked to do, or what is wrong with a task file of one's own."""

import argparse
from pathlib import Path
from typing import Any

from tcbi_bringup.commands import console

SUMMARY = "List the tasks with their rewards, or check a task of your own."
USAGE = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi tasks                                 # duration, ground, reward with its units",
        "./tcbi tasks check turn.py                   # what is wrong with it, each fault in a line",
        "cp turn.py ~/.local/share/tcbi/tasks/ && ./tcbi train --task turn",
    )
    parser.add_argument("action", nargs="?", choices=("list", "check"), default="list", help="default: list")
    parser.add_argument("file", nargs="?", type=Path, help="the file to check")
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List or check."""
    if (args.file is None) != (args.action == "list"):
        console.note(f"tcbi: usage: ./tcbi tasks {'list' if args.action == 'list' else 'check FILE'}")
        return USAGE
    return _check(args) if args.action == "check" else _list(args)


def _list(args: argparse.Namespace) -> int:
    from tcbi_policy.reward import formula, terms_of
    from tcbi_sim.tasks import tasks, tasks_folder

    keys = ("name", "weight", "unit", "formula")
    facts: list[dict[str, Any]] = [
        {
            "task": task.name, "description": task.description, "duration_s": task.duration, "blocks": task.blocks,
            "reward": formula(task.name), "terms": [{k: getattr(t, k) for k in keys} for t in terms_of(task.name)],
        }
        for task in tasks().values()
    ]  # fmt: skip
    if args.json:
        console.emit({"tasks": facts, "folder": str(tasks_folder())})
        return 0
    rows = [[f["task"], f["description"], f["duration_s"], f["blocks"]] for f in facts]
    console.table("", ["task", "what", "duration / s", "blocks at most"], rows)
    for f in facts:
        print(f"{f['task']}: {f['reward']}")
    print("x: progress / m, e: (|roll| + |pitch|) / 2 / rad, a: joint targets / rad; ' is the end of the control step")
    print(f"your own: one file each in {tasks_folder()} (docs/policies.md)")
    return 0


def _check(args: argparse.Namespace) -> int:
    from tcbi_policy.task_check import check_file_apart

    with console.progress(f"trying {args.file.name}"):
        task, faults = check_file_apart(args.file)
    if args.json:
        console.emit({"file": str(args.file), "task": task, "faults": faults})
    else:
        for fault in faults:
            print(f"{args.file}: {fault}")
        if not faults:
            print(f"{args.file}: task {task} is fit for use; copy it to the folder that ./tcbi tasks names")
    return 1 if faults else 0
