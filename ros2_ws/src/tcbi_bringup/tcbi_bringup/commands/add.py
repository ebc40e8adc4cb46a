"""`./tcbi add`: a new model version with an effect in it."""

import argparse
from pathlib import Path

from tcbi_bringup.commands import console

SUMMARY = "Make a new model version with an effect in it; the old versions stay."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi add coulomb_friction                          # as the last diagnosis of the latest model fitted it",
        "./tcbi add weak_leg:lm rollouts/*                    # fit it to these bags now",
        "./tcbi add backlash --diagnosis why.json --model hexapod-v1",
        "./tcbi add payload --prior                           # without any fit",
    )
    parser.add_argument("effect", help="an effect's name, or name:site")
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG", help="bags to fit it to")
    parser.add_argument("--model", default="latest", help="the parent version (default: latest)")
    parser.add_argument("--rig", default="hexapod", help="whose latest version, without bags (default: hexapod)")
    parser.add_argument("--diagnosis", type=Path, metavar="FILE", help="what `diagnose --json` wrote")
    parser.add_argument("--prior", action="store_true", help="keep the parameters as wide as their prior")
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Find or make the fit, save the version, print."""
    from tcbi_infer.bags.reader import read_measurements
    from tcbi_infer.diagnose import adopt
    from tcbi_infer.errors import InferError
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    measurements = read_measurements(args.bags) if args.bags else []
    model = store.load(args.model, measurements[0].rig if measurements else args.rig)
    if args.prior:
        child = model.with_effect(args.effect)
    else:
        if args.diagnosis:
            diagnosis = adopt.read(args.diagnosis)
        elif measurements:
            model.with_effect(args.effect)  # a wrong name is told before the fit, not after it
            with console.progress("fitting", total=100) as advance:
                fitted = adopt.fit_effect(
                    model,
                    args.effect,
                    measurements,
                    progress=lambda stage, share: advance(done=round(100 * share), note=stage),
                )
            diagnosis = fitted.to_json()
        else:
            model.with_effect(args.effect)
            found = adopt.latest(store.folder("runs"), model.version, args.effect)
            if found is None:
                raise InferError(
                    f"no diagnosis of {model.version} has fitted {args.effect!r}; run ./tcbi diagnose first, "
                    "give bags, or keep the prior with --prior"
                )
            diagnosis = found
        child = adopt.adopt(model, args.effect, diagnosis)
    saved = store.save(child)
    if args.json:
        console.emit({"model": saved.version, "parent": model.version, "effect": args.effect})
        return 0
    print(f"{saved.version} = {model.version} + {args.effect}")
    if not args.prior and not saved.evidence["accepted"]:
        print("note: the diagnosis did not accept this effect; the version is a guess")
    rows = [[p.name, p.unit, float(v)] for p, v in zip(saved.parameters, saved.mean(), strict=True)]
    console.table("mean parameters", ["parameter", "unit", "mean"], rows)
    return 0
