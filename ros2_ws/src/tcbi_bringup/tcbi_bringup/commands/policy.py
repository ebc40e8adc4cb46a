"""`./tcbi policy`: list, show, measure and export policies."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from tcbi_bringup.arguments import at_least
from tcbi_bringup.commands import console
from tcbi_bringup.errors import WrongCallError

UNITS = {
    **{"cpu_s": "s", "mean_return": "points", "sd_return": "points"},
    **dict.fromkeys(("mean_return_low95", "mean_return_high95"), "points"),
    **{"final_inclination_deg": "deg", "distance_m": "m", "median_distance_m": "m"},
    **{"over_blocks": "rollouts", "foot_over_blocks": "rollouts", "past_blocks_share": "share", "past_blocks_s": "s"},
    **{"blocks_under_feet": "blocks", "distance_over_blocks_m": "m", "distance_not_over_blocks_m": "m"},
}
POINTS = "return: points of the task's reward, summed over an episode; docs/policies.md says what each is given for"
ROLLOUTS, SEED = 64, 1
SUMMARY = "List the policies, show one's card, measure it in simulations drawn from a model, or export it."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to look at."""
    parser.add_argument("policy", nargs="?", default="", help="policy file, its name, or gait:NAME; nothing lists all")
    parser.add_argument(
        "--measure", action="store_true", help="roll it out; report return, inclination, distance, and blocks gone over"
    )
    console.add_task(parser, ": where to measure it (default: the one that it was trained for)")
    console.add_model(parser, "model version whose parameters are drawn")
    parser.set_defaults(model=None)  # so that it is seen that none was given
    parser.add_argument("--rollouts", type=at_least(1), help=f"how many rollouts to measure with (default: {ROLLOUTS})")
    parser.add_argument("--seed", type=at_least(0), help=f"of parameters and scenarios (default: {SEED})")
    parser.add_argument(
        "--onnx", type=Path, metavar="FILE", help="write the network, scaling included, as an ONNX model"
    )
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi policy",
        "./tcbi policy balance",
        "./tcbi policy balance --onnx balance.onnx",
        "./tcbi policy gait:tripod --measure --task forward --rollouts 32",
    )


def run(args: argparse.Namespace) -> int:
    """List, show or measure."""
    from tcbi_policy.artefact import Policy, find_policy
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    for option in ("task", "model", "rollouts", "seed"):
        if getattr(args, option) not in (None, "") and not args.measure:
            raise WrongCallError(f"--{option}: got it without --measure, which alone looks at it; add --measure")
    if not args.policy:
        if args.onnx or args.measure:
            raise WrongCallError("--onnx and --measure: got no policy; name one that ./tcbi policy lists")
        return _list(args, store.root)
    policy = find_policy(args.policy, store.root)
    facts = _facts(policy)
    if args.json and isinstance(policy, Policy):
        facts["card"] = dataclasses.asdict(policy.card)
    if args.onnx:
        facts["onnx"] = _export(policy, args.onnx)
    if args.measure:
        facts["measured"] = _measure(args, store, policy)
    if args.json:
        console.emit(facts)
    else:
        measured = facts.pop("measured", {})
        card = _card(policy.card) if isinstance(policy, Policy) else []
        found = [[[key, value, UNITS.get(key, "")] for key, value in shown.items()] for shown in (facts, measured)]
        for title, rows in ((policy.policy_id, found[0]), ("card", card), ("measured in simulations", found[1])):
            if told := [row for row in rows if row[1] not in ("", None)]:
                console.table(title, ["what", "value", "unit"], told)
        print(POINTS)
    return 0


def _list(args: argparse.Namespace, root: Any) -> int:
    from tcbi_policy.artefact import GAIT_PREFIX, policy_paths
    from tcbi_policy.gaits import GAITS

    policies = [_facts(policy) for policy in readable(policy_paths(root)).values()]
    gaits = [f"{GAIT_PREFIX}{name}" for name in GAITS]
    if args.json:
        console.emit({"policies": policies, "gaits": gaits})
        return 0
    rows = [[p["policy_id"], p["task"], p["model"], p["mean_return"], p["created"]] for p in policies]
    console.table("trained policies", ["policy", "task", "model", "best evaluation / points", "made"], rows)
    print(POINTS)
    print(f"scripted gaits: {', '.join(gaits)}")
    return 0


def readable(paths: dict[str, Path]) -> dict[str, Any]:
    """Those of some policies that can be read, by name; a note names each other one."""
    from tcbi_policy.artefact import load_all

    found, faults = load_all(paths)
    for fault in faults:
        console.note(f"left out: {fault}")
    return found


def _facts(policy: Any) -> dict[str, Any]:
    from tcbi_policy.artefact import Policy

    if not isinstance(policy, Policy):
        return {"policy_id": policy.policy_id, "task": "", "description": "scripted gait"}
    card, training = policy.card, policy.card.training
    facts = {"policy_id": policy.policy_id, "path": str(policy.path), "steps": training.get("steps_taken")}
    facts |= {key: getattr(card, key) for key in ("task", "model", "parent", "created")}
    return facts | {key: training.get(key) for key in ("algorithm", "cpu_s", "seed", "mean_return", "best_steps")}


def _card(card: Any) -> list[list[str]]:
    """What a policy sees and sets, what it was trained on and with: rows of the table; --json has all the numbers."""
    from tcbi_policy.configuration import TrainingConfig

    layout, training = card.layout, card.training
    drawn = [
        f"{name} {v['mean']:.3g} +- {v['sd']:.2g} {v['unit']}".removesuffix(" 1") for name, v in card.posterior.items()
    ]
    known = {key: training[key] for key in ("observation_noise", "effects", "effect_share") if key in training}
    also = TrainingConfig(card.task, **known).randomisation()
    return [
        [f"observation ({len(layout.observation)})", ", ".join(layout.observation), layout.unit],
        [f"action ({len(layout.action)})", ", ".join(layout.action), layout.unit],
        ["limit of an action", f"{layout.limit:.4g}", layout.unit],
        ["rate", f"{layout.rate_hz:g}", "Hz"],
        ["trained on, mean +- sd", ", ".join(drawn), ""],
        ["trained with", also, ""],
        ["libraries", ", ".join(f"{name} {version}" for name, version in card.libraries.items()), ""],
    ]


def _export(policy: Any, path: Path) -> str:
    from tcbi_contract.files import replace_file
    from tcbi_policy.artefact import Policy
    from tcbi_policy.errors import PolicyError
    from tcbi_policy.onnx_file import to_onnx

    if not isinstance(policy, Policy):
        raise PolicyError(f"{policy.policy_id} is a script and has no network to export; name a trained policy")
    if path.is_dir():
        raise PolicyError(f"--onnx: {path} is a folder; name a file, such as {path / policy.card.name}.onnx")
    if path.suffix != ".onnx":
        raise PolicyError(f"--onnx: got {path}, allowed is a file of the ending .onnx: {path.with_suffix('.onnx')}")
    if not path.parent.is_dir():
        raise PolicyError(f"{path.parent} is no folder; make it, or give another path to --onnx")
    replace_file(path, to_onnx(policy.mlp, policy.card))
    return str(path)


def _measure(args: argparse.Namespace, store: Any, policy: Any) -> dict[str, Any]:
    from tcbi_policy.artefact import Policy
    from tcbi_policy.evaluation import check_rig, draw_conditions, evaluate
    from tcbi_sim.store import LATEST
    from tcbi_sim.tasks import tasks

    task = args.task or (policy.card.task if isinstance(policy, Policy) else "")
    if not task:
        raise WrongCallError(f"--task: {policy.policy_id} belongs to no task; name one of {', '.join(tasks())}")
    model = console.load_model(store, args.model or LATEST)
    check_rig(policy.policy_id, model)
    rollouts, seed = args.rollouts or ROLLOUTS, SEED if args.seed is None else args.seed
    with console.progress(f"measuring {policy.policy_id} on {rollouts} rollouts of {task}"):
        found = evaluate(policy, model, draw_conditions(model, task, rollouts, seed))
    low, high = found.interval()
    interval = {"mean_return_low95": low, "mean_return_high95": high}
    return {"task": task, "model": model.version, "rollouts": rollouts, "seed": seed, **found.summary(), **interval}
