"""`./tcbi view`: show a model version doing a task, in a window or as a picture and a video."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from tcbi_bringup.arguments import at_least
from tcbi_bringup.commands import console

if TYPE_CHECKING:
    from tcbi_policy.artefact import Actor
    from tcbi_sim.model import Model
    from tcbi_sim.view import Film

WALK = "gait:tripod"
SUMMARY = "Show a model version: in a window, or as a picture and a video where there is no display."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to show, and where to."""
    console.add_model(parser, "version to show")
    parser.add_argument("--rig", default="hexapod", help="rig whose newest version is shown (default: hexapod)")
    console.add_task(parser, default="forward")
    parser.add_argument("--seed", type=at_least(0), default=3, help="draws the terrain and the posture (default: 3)")
    parser.add_argument(
        "--policy",
        default="",
        help=f"policy file, its name in the store, or gait:NAME (default: {WALK}; a rig that it does not fit is still)",
    )
    parser.add_argument("--seconds", type=at_least(0.1), default=8.0, help="length of the video (default: 8)")
    parser.add_argument("--png", type=Path, help="write a picture of the start here")
    parser.add_argument("--video", type=Path, help="write an MP4 here")
    console.add_store(parser)
    console.add_examples(
        parser,
        "./tcbi view",
        "./tcbi view --task balance --seed 7 --png robot.png",
        "./tcbi view --model hexapod-v1 --policy gait:tripod --video walk.mp4",
    )


def prepare(args: argparse.Namespace) -> None:
    """Choose the renderer, before anything imports MuJoCo."""
    from tcbi_sim import view

    if not _in_window(args):
        view.prepare_headless()


def run(args: argparse.Namespace) -> int:
    """Draw."""
    from tcbi_sim import view
    from tcbi_sim.store import ModelStore

    window = _in_window(args)
    store = ModelStore(args.store)
    model = console.load_model(store, args.model, args.rig)
    film, policy = _film(args, model), _policy(args, model.rig, store.root)
    if window:
        film.open(policy, args.seconds)
        return 0
    if not args.png and not args.video:
        args.png, args.video = Path("tcbi_view.png"), Path("tcbi_view.mp4")
        console.note(f"{view.why_no_window()}: rendering to files instead of a window")
    if args.png:
        film.save_picture(args.png)
        console.note(f"picture: {args.png}")
    if args.video:
        with console.progress("rendering", total=round(args.seconds * view.FRAME_RATE)) as advance:
            film.save_video(args.video, policy, args.seconds, advance)
        console.note(f"video: {args.video}")
    return 0


def _in_window(args: argparse.Namespace) -> bool:
    from tcbi_sim import view

    return not (args.png or args.video) and not view.why_no_window()


def _film(args: argparse.Namespace, model: "Model") -> "Film":
    import numpy as np

    from tcbi_sim.measurement import Scenario
    from tcbi_sim.tasks import find_task
    from tcbi_sim.view import Film

    if model.rig != "hexapod":
        return Film(model, Scenario("", args.seconds))
    return Film(model, find_task(args.task).draw(np.random.default_rng(args.seed), args.seed))


def _policy(args: argparse.Namespace, rig_name: str, root: Path) -> "Actor | None":
    """The policy that is named, else the walk, or none on a rig that the walk does not fit."""
    from tcbi_policy.artefact import find_policy
    from tcbi_policy.errors import PolicyMisfit
    from tcbi_policy.layout import robot_layout
    from tcbi_sim.rigs import load_rig

    rig = load_rig(rig_name)
    robot = robot_layout(rig.joint_names, rig.joint_range)
    try:
        return find_policy(args.policy or WALK, root, robot)
    except PolicyMisfit:
        if args.policy:
            raise
        console.note(f"{rig_name} holds still: {WALK} does not fit it")
        return None
