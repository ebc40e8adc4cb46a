"""`./tcbi view`: show a model version doing a task, in a window or as a picture and a video."""

import argparse
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import above, at_least
from tcbi_bringup.commands import console

SUMMARY = "Show a model version: in a window, or as a picture and a video where there is no display."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to show, and where to."""
    console.add_model(parser, "version to show")
    parser.add_argument("--rig", default="hexapod", help="rig whose newest version is shown (default: hexapod)")
    console.add_task(parser, default="forward")
    parser.add_argument("--seed", type=at_least(0), default=3, help="draws the terrain and the posture (default: 3)")
    parser.add_argument("--policy", default="gait:tripod", help="policy file, its name in the store, or gait:NAME")
    parser.add_argument("--seconds", type=above(0.0), default=8.0, help="length of the video (default: 8)")
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

    window = _in_window(args)
    film, policy = _film(args), _policy(args)
    if window:
        film.open(policy, args.seconds)
        return 0
    if not args.png and not args.video:
        args.png, args.video = Path("tcbi_view.png"), Path("tcbi_view.mp4")
        console.note("no display: rendering to files instead of a window")
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

    return not (args.png or args.video) and view.has_display()


def _film(args: argparse.Namespace) -> Any:
    import numpy as np

    from tcbi_sim.measurement import Scenario
    from tcbi_sim.store import ModelStore
    from tcbi_sim.tasks import find_task
    from tcbi_sim.view import Film

    model = console.load_model(ModelStore(args.store), args.model, args.rig)
    if model.rig != "hexapod":
        return Film(model, Scenario("", args.seconds))
    return Film(model, find_task(args.task).draw(np.random.default_rng(args.seed), args.seed))


def _policy(args: argparse.Namespace) -> Any:
    from tcbi_policy.artefact import find_policy
    from tcbi_sim.store import ModelStore

    return find_policy(args.policy, ModelStore(args.store).root)
