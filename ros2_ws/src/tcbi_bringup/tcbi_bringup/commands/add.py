"""`./tcbi add`: a new model version with an effect in it."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import existing_file
from tcbi_bringup.commands import console
from tcbi_bringup.errors import WrongCallError

if TYPE_CHECKING:
    from tcbi_sim.measurement import Measurement
    from tcbi_sim.model import Model

SUMMARY = "Make a new model version with an effect in it; the old versions stay."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi add coulomb_friction                          # as the last diagnosis of the latest model fitted it",
        "./tcbi add weak_leg:lm rollouts/*                    # fit it to these bags now",
        "./tcbi add backlash --diagnosis why.json --model hexapod-v1",
        "./tcbi add weak_leg:lm --anyway                      # though the kinds of motion disagree on its size",
        "./tcbi add payload --prior                           # without any fit",
    )
    parser.add_argument("effect", help="an effect's name, or name:site")
    console.add_bags(parser, " to fit it to", least=0)
    console.add_model(parser, "the parent version")
    parser.add_argument("--rig", default="hexapod", help="whose newest version, without bags (default: hexapod)")
    parser.add_argument(
        "--diagnosis", type=existing_file, metavar="FILE", help="what `diagnose --json` wrote, in place of bags"
    )
    parser.add_argument(
        "--prior", action="store_true", help="keep the parameters as wide as their prior; no bags, no diagnosis"
    )
    parser.add_argument(
        "--anyway", action="store_true", help="add it though the kinds of motion disagree on the effect's size"
    )
    console.add_report(parser)
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Find or make the fit, save the version, report, print."""
    from tcbi_infer.report import Report, add_kept_ladder, add_version
    from tcbi_sim.store import ModelStore

    given = {"bags": args.bags, "--diagnosis": args.diagnosis, "--prior": args.prior}
    if len(several := [name for name, value in given.items() if value]) > 1:
        raise WrongCallError(f"{' and '.join(several)}: each says where the size comes from; give one of them")
    if args.anyway and args.prior:
        raise WrongCallError("--anyway and --prior: a prior has no size to disagree on; give one of them")
    store = ModelStore(args.store)
    measurements = console.read_bags(args)
    console.note_findings(measurements)
    model = console.load_model(store, args.model, measurements[0].rig if measurements else args.rig)
    child = model.with_effect(args.effect)  # a wrong name is told before a fit, not after it
    if not args.prior:
        child = _fitted(args, model, measurements, store.folder("runs"))
    saved = store.save(child)
    report = Report(f"{saved.version}: {model.version} with {args.effect}", "A new model version.")
    if "errors" not in saved.evidence:
        add_kept_ladder(report, model, store.history(model.rig))
    add_version(report, model, saved)
    path = report.write(args.report or store.folder("reports") / f"add-{saved.version}.html")
    if args.json:
        errors = saved.evidence.get("errors", {})
        console.emit(
            {
                "model": saved.version,
                "parent": model.version,
                "effect": args.effect,
                "accepted": bool(saved.evidence.get("accepted", False)),
                "disagreements": saved.evidence.get("disagreements", []),
                "error_before": errors.get("base"),
                "error_after": errors.get(args.effect),
                "report": str(path),
            }
        )
    else:
        _print(model, saved, args.effect, path)
    return 0


def _fitted(args: argparse.Namespace, model: "Model", measurements: "list[Measurement]", runs: Path) -> "Model":
    """The version as a diagnosis fitted it: a given one, one made now, or the newest that is remembered."""
    from tcbi_infer.diagnose import adopt
    from tcbi_infer.errors import InferError

    if args.diagnosis:
        found: Mapping[str, Any] | None = adopt.read(args.diagnosis)
    elif measurements:
        with console.progress("fitting", total=100) as advance:
            fitted = adopt.fit_effect(
                model,
                args.effect,
                measurements,
                progress=lambda stage, share: advance(done=round(100 * share), note=stage),
            )
        found = fitted.to_json()
    else:
        found = adopt.latest(runs, model.version, args.effect)
    if found is None:
        raise InferError(
            f"no diagnosis of {model.version} has fitted {args.effect!r}; run ./tcbi diagnose first, give bags, "
            "name another version (--model) or rig (--rig), or keep the prior with --prior"
        )
    take = adopt.adopt if args.anyway else adopt.offered
    return take(model, args.effect, found)


def _print(model: "Model", saved: "Model", effect: str, path: Path) -> None:
    from tcbi_infer.diagnose.adopt import doubt

    print(f"{saved.version} = {model.version} + {effect}")
    rows = [[p.name, p.unit, float(v)] for p, v in zip(saved.parameters, saved.mean(), strict=True)]
    console.table("mean parameters", ["parameter", "unit", "mean"], rows)
    if saved.joint_gains:
        print(f"joints' own gains, over what the parameters say: {saved.joint_gains_told}")
    errors = saved.evidence.get("errors", {})
    if effect in errors:
        judged = "rollouts that no fit has seen" if saved.evidence["sealed"] else "motions held out in turn"
        if saved.evidence["nothing_held_out"]:
            judged = "the motion of the fit itself, which says nothing of others"
        print(
            f"error over the noise floor on {judged}: {_error(errors['base'])} with {model.version} "
            f"fitted again, {_error(errors[effect])} with {saved.version}"
        )
        if why := doubt(saved.evidence):
            print(f"note: {effect} is a guess: the diagnosis {why}. {saved.evidence['statement']}")
        for told in saved.evidence["disagreements"]:
            print(f"note: {told}")
    else:
        print(f"its size is as wide as the prior; measure it: ./tcbi compare BAG… --model {saved.version}")
    print(f"report: {path}")


def _error(over_floor: float | None) -> str:
    """As JSON keeps an error, which has no infinity."""
    return "no prediction (it diverges)" if over_floor is None else f"{over_floor:.1f}"
