"""`./tcbi train`: train a policy for a task on draws of a model."""

import argparse
import dataclasses
import math
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import above, at_least, not_empty, seed
from tcbi_bringup.commands import console
from tcbi_bringup.errors import BringupError, WrongCallError

SUMMARY = "Train a policy for a task in simulations drawn from a model; a run that was interrupted goes on."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to train, on what, and for how long."""
    console.add_task(parser, required=True)
    parser.add_argument(
        "--preset", default="fast", help="fast (minutes, PPO) or paper (half a day and more, SAC as in the paper)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of everything that is drawn (default: 0)")
    parser.add_argument(
        "--out", type=not_empty, help="name in the store, or path of a .safetensors file (default: TASK-N)"
    )
    console.add_model(parser, "model version whose parameters are drawn")
    parser.add_argument("--start", default="", help="policy to go on from (default: from scratch)")
    parser.add_argument(
        "--steps", type=at_least(1), default=0, help="control steps of all simulations together (default: the preset's)"
    )
    parser.add_argument(
        "--budget", type=above(0.0), default=0.0, metavar="SECONDS",
        help="train for this time instead of for the preset's steps; start-up and the evaluation at the end "
        "come on top; with --steps, for whichever is over first",
    )  # fmt: skip
    parser.add_argument(
        "--prior", action="store_true", help="draw from the prior of the model's parameters, not from its posterior"
    )
    parser.add_argument(
        "--effect", action="append", metavar="NAME[:PLACE]",
        help="a further effect that half of the episodes have, such as command_latency or lost_commands; repeatable "
        "(default: those of --start)",
    )  # fmt: skip
    parser.add_argument(
        "--noise",
        type=at_least(0.0),
        metavar="RAD",
        help="standard deviation of noise on the observation (default: that of --start, else 0)",
    )
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi train --task balance",
        "./tcbi train --task forward --seed 3 --out walker --json",
        "./tcbi train --task balance --model hexapod-v2 --start balance --budget 120",
        "./tcbi train --task balance --noise 0.02 --effect command_latency --effect lost_commands --out robust",
    )


def run(args: argparse.Namespace) -> int:
    """Train, and keep the result."""
    from tcbi_policy.runs import TrainingProcess, write_run
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    planned = plan(args, store)
    folder = write_run(store.folder("runs") / planned.key("train"), planned)
    console.note_model(args.model, planned.model)
    console.note(f"training {args.task} on {planned.model}; interrupted, the same command goes on from {folder}")
    console.note(f"to watch it with TensorBoard, which you install yourself: tensorboard --logdir {folder}")
    done: dict[str, Any] = {}
    with TrainingProcess(folder) as process, console.progress("training", total=1.0) as advance:
        for event in process.events():
            follow(event, advance)
            done = event if event["event"] == "done" else done
    path, logged = _publish(folder, args.out or "", store.root)
    result = {"policy": str(path), "policy_id": f"{path.stem}@{done['policy_id'].partition('@')[2]}", "task": args.task,
              "model": planned.model, "steps": done["steps"],
              "mean_return": done["mean_return"], "best_steps": done["best_steps"],
              "seconds": done["elapsed_s"], "cpu_seconds": done["cpu_s"], "tensorboard": str(logged)}  # fmt: skip
    if args.json:
        console.emit(result)
    else:
        print(
            f"{result['policy_id']}: mean return {_known(done['mean_return']):.0f}, the best evaluation, after "
            f"{done['best_steps']} of {done['steps']} steps, {path}"
        )
        print(f"what was logged: tensorboard --logdir {logged}")
    return 0


def plan(args: argparse.Namespace, store: Any) -> Any:
    """The training run that is asked for; one that goes on from a policy meets what that was trained with.

    Raises:
      TcbiError: an unknown task, preset, model, effect or policy.
      WrongCallError: `--out` gives the policy no name, or a preset cannot go on from a policy.
    """
    from tcbi_policy.artefact import Policy, find_policy
    from tcbi_policy.configuration import check_start, preset
    from tcbi_policy.evaluation import check_rig
    from tcbi_policy.randomisation import randomised
    from tcbi_policy.retraining import fine_tuning, randomisation_of
    from tcbi_policy.runs import Run

    check_place(args.out or "", store.root)
    config, model = preset(args.preset, args.task), store.load(args.model)
    check_rig(f"of {args.task}", model)
    changes: dict[str, Any] = {"seed": args.seed, "budget_s": args.budget, "prior": args.prior}
    if args.start and config.algorithm == "sac":
        raise WrongCallError(
            f"--start: the preset {args.preset} (SAC) begins with random actions and would forget {args.start}; go on "
            "from a policy with --preset fast"
        )
    if args.start:
        config, start = fine_tuning(config), find_policy(args.start, store.root)
        if not isinstance(start, Policy):
            raise WrongCallError(f"--start: got {args.start}, a scripted gait; allowed is a trained policy")
        check_start(config, start)
        if start.card.task != args.task:
            console.note(f"{start.policy_id} was trained for {start.card.task}; it goes on with {args.task}")
        changes |= randomisation_of(start, args.task, model)
    changes["steps"] = args.steps or (0 if args.budget else config.steps)
    given = {"effects": args.effect and tuple(args.effect), "observation_noise": args.noise}
    changes |= {name: value for name, value in given.items() if value is not None}
    config = dataclasses.replace(config, **changes).checked()
    randomised(model, config.effects, config.effect_share)  # refuses what cannot be before a process is started
    if args.start and (also := config.randomisation()):
        console.note(f"training with {also}")
    return Run.of(config, model, store.root, args.start)


def check_place(out: str, root: Path) -> None:
    """Refuse, before a training begins, a place where its policy could not be kept.

    Raises:
      WrongCallError: `--out` gives the policy no name, a folder, or that of a policy that is there.
      BringupError: nothing can be written there.
    """
    name = Path(out).name
    if out and (not name or name.startswith(".")):
        raise WrongCallError(
            f"--out: got {out!r}, allowed is a name, or a path that ends in one; it begins with no dot"
        )
    if out and out == name and not out.endswith(".safetensors"):
        _check_name(out)
    if out.endswith(os.sep) or (os.sep in out and Path(out).expanduser().is_dir()):
        raise WrongCallError(f"--out: {out} is a folder; add the policy's name, such as {Path(out) / 'mine'}")
    stem = _stem(out or "any", root)
    if out and (there := stem.with_name(f"{stem.name}.safetensors")).exists():
        raise WrongCallError(f"--out: {there} is there already; give another name, or remove it first")
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=stem.parent):
            pass
    except OSError as e:
        raise BringupError(f"{stem.parent}: {e.strerror}; name a folder that can be written to") from e


def _check_name(name: str) -> None:
    """Refuse a name in the store that could not be told from another policy's."""
    from tcbi_policy.artefact import policy_paths

    if not re.fullmatch(r"\w[\w.-]*", name, re.ASCII) or name.endswith((".json", ".onnx")):
        raise WrongCallError(f"--out: got {name!r}, allowed are letters, digits, _, - and dots, without an ending")
    if name in policy_paths():
        raise WrongCallError(f"--out: {name!r} is the name of a shipped policy, which it would hide; give another name")


def _stem(out: str, root: Path) -> Path:
    """Where a policy lies, without its endings."""
    if out.endswith(".safetensors") or os.sep in out:
        return Path(out.removesuffix(".safetensors")).expanduser()
    return root / "policies" / out


def _publish(folder: Path, out: str, root: Path) -> tuple[Path, Path]:
    """Keep the policy under a name in the store or as a file, and what was logged: both places.

    The run's folder is then done with. Without a name the policy gets the next free one of its task. What was logged
    moves to `tensorboard/NAME` of the store, or beside the file as `NAME.tensorboard`.

    Raises:
      BringupError: what was logged cannot be copied there; the policy is kept.
    """
    import shutil

    from tcbi_policy.artefact import load_policy, locked, save_policy
    from tcbi_policy.retraining import next_name

    trained = load_policy(folder / "policy.safetensors")
    with locked(root / "policies"):
        stem = _stem(out or next_name(root, trained.card.task), root)
        path = save_policy(stem, trained.mlp, dataclasses.replace(trained.card, name=stem.name)).path
    assert path is not None
    logged = (
        root / "tensorboard" / stem.name
        if stem.parent == root / "policies"
        else stem.with_name(f"{stem.name}.tensorboard")
    )
    shutil.rmtree(logged, ignore_errors=True)
    try:
        shutil.copytree(folder / "tensorboard", logged)
    except OSError as e:  # shutil.Error, too, which has no number but a list of (from, to, why)
        why = e.args[0][0][2] if isinstance(e, shutil.Error) else e.strerror
        raise BringupError(
            f"the policy is saved as {path}, but its log cannot be copied to {logged}: {why}; make room or choose "
            f"another --store; the log stays in {folder}"
        ) from e
    shutil.rmtree(folder, ignore_errors=True)
    return path, logged


def _known(value: float | None) -> float:
    """NaN for null."""
    return math.nan if value is None else value


def follow(event: dict[str, Any], advance: Any) -> None:
    """Show one event of a training."""
    kind = event["event"]
    if kind == "progress":
        left_s = event["remaining_s"]
        total = f" of {event['total_steps']}" if event["total_steps"] else ""
        note = f"{event['steps']}{total} steps, return {_known(event['mean_return']):.0f} at the last evaluation"
        advance(done=event["share"], left_s=math.nan if left_s is None else left_s, note=note)
    elif kind == "comparing":
        advance(
            done=1.0, left_s=math.nan, note=f"comparing with {event['rival']} on {event['pairs']} held-out rollouts"
        )
    elif kind == "evaluation":
        lost = f", {event['diverged']} of {event['rollouts']} diverged" if event["diverged"] else ""
        console.note(
            f"{event['steps']} steps: return {_known(event['mean_return']):.0f} +- {_known(event['sd_return']):.0f}, "
            f"final inclination {_known(event['final_inclination_deg']):.1f} degrees, "
            f"distance {_known(event['distance_m']):.2f} m{lost}"
        )
    elif kind == "imitation":
        console.note(
            f"copies the gait, round {event['round']} of {event['rounds']}: off by {event['error_rad']:.3f} rad"
        )
    elif kind in ("resumed", "restarted"):
        console.note(event.get("reason") or f"goes on from {event['steps']} steps")
