"""`./tcbi diagnose`: which physical effect a model lacks, with its size, its error bars and an honest verdict."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import at_least
from tcbi_bringup.commands import console
from tcbi_contract.wording import counted

if TYPE_CHECKING:
    from tcbi_infer.diagnose import Diagnosis
    from tcbi_infer.diagnose.evidence import Evidence
    from tcbi_infer.diagnose.rounds import Round

SHOWN = 10  # candidates in the table, and those that the verdict names
SUMMARY = "Find the physical effect that a model lacks: candidates ranked on held-out motions, and a verdict."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi diagnose rollouts/*                           # the latest model, all effects of the library",
        "./tcbi diagnose rollouts/* --model hexapod-v1 --report why.html",
        "./tcbi diagnose rollouts/* --effects coulomb_friction,backlash --json",
        "./tcbi diagnose rollouts/* --show backlash                # and which motion would show it best",
        "./tcbi diagnose rollouts/* --add                          # add what is found, and look for more",
        "./tcbi diagnose rollouts/* --workers ray:HOST:6379          # on a Ray cluster (docs/scale.md)",
    )
    console.add_bags(parser)
    console.add_model(parser)
    parser.add_argument("--effects", help="comma-separated candidates (default: the whole library)")
    parser.add_argument(
        "--show", metavar="EFFECT", help="comma-separated candidates of which to say which motion would show them best"
    )
    parser.add_argument(
        "--add",
        action="store_true",
        help="save what is found as a new version and diagnose that, until no effect is named (three effects at most)",
    )
    thorough = parser.add_mutually_exclusive_group()
    thorough.add_argument(
        "--refine", type=at_least(0), default=3, help="candidates that get a full fit, at most (default: 3)"
    )
    thorough.add_argument(
        "--quick",
        action="store_true",
        help="a first answer from few motions: no single joints, two fits, nothing sealed",
    )
    parser.add_argument(
        "--trust-recording",
        action="store_true",
        help="search although the recordings look wrong: swapped or mirrored joints, other units, echoed commands",
    )
    console.add_workers(parser)
    console.add_report(parser)
    parser.add_argument(
        "--seed", type=at_least(0), default=0, help="of the split and of the simulated null data (default: 0)"
    )
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read, diagnose, remember, report, print; with `--add`, again with what was found."""
    from tcbi_infer.diagnose.candidates import find_candidates
    from tcbi_infer.diagnose.rounds import MOST, rounds
    from tcbi_infer.diagnose.settings import QUICK, Settings
    from tcbi_sim.store import ModelStore

    measurements = console.read_bags(args)
    noted = console.note_findings(measurements)
    store = ModelStore(args.store)
    model = console.load_model(store, args.model, measurements[0].rig)
    found: list[Round] = []
    paths: list[Path] = []
    with console.progress("diagnosing", total=100) as advance:
        for one in rounds(
            model,
            measurements,
            most=MOST if args.add else 1,
            uses=find_candidates(model, args.effects.split(",")) if args.effects else None,
            keep=store.save if args.add else None,
            settings=dataclasses.replace(
                QUICK if args.quick else Settings(refine=args.refine),
                seed=args.seed,
                trust_recording=args.trust_recording,
            ),
            progress=lambda stage, share: advance(done=round(100 * share), note=stage),
            show=find_candidates(model, args.show.split(",")) if args.show else (),
        ):
            paths.append(_write(args.report, one, found, store.folder("runs")))
            found.append(one)
            if one.added and args.add:
                console.note(f"{one.resolved or one.diagnosis.statement} {one.use} is in {one.added.version} now")
    if args.json:
        console.emit(_as_json(found, paths, saved=args.add))
        return 0
    for one, path in zip(found, paths, strict=True):
        _print(one.diagnosis, path, added=args.add, noted=noted)
        if one.resolved:
            print(one.resolved)
    if args.add:
        _print_steps(found)
    return 0


def _write(given: Path | None, one: "Round", earlier: "list[Round]", runs: Path) -> Path:
    """Remember a diagnosis and write its report; the file's name is for the first, later ones add their model's."""
    from tcbi_infer.diagnose.adopt import remember
    from tcbi_infer.diagnose.rounds import steps
    from tcbi_infer.report import Report, add_diagnosis

    d = one.diagnosis
    saved = remember(d, runs)
    report = Report("What does the model lack?", f"Model {d.model}, {counted(len(d.rollouts), 'rollout')}.")
    add_diagnosis(report, d, earlier=steps(earlier))
    if given and earlier:
        given = given.with_stem(f"{given.stem}-{d.model}")
    return report.write(given or saved.with_suffix(".html"))


def _as_json(found: "list[Round]", paths: list[Path], *, saved: bool) -> dict[str, Any]:
    """The first diagnosis; those that followed, and the versions that were made, if any were saved."""
    first, *then = [
        {
            **r.diagnosis.to_json(),
            "report": str(path),
            "added": r.added.version if saved and r.added else None,
            "use": r.use or None,
            "resolved": r.resolved or None,
        }
        for r, path in zip(found, paths, strict=True)
    ]
    return {**first, "then": then}


def _print(d: "Diagnosis", path: Path, *, added: bool, noted: Sequence[str]) -> None:
    from tcbi_infer.diagnose import detectable, excitation
    from tcbi_infer.diagnose.adopt import objection
    from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, OUTSIDE_LIBRARY, step_label

    for finding in d.guards:
        if finding not in noted:  # told before the search
            print(f"note: {finding}")
    judged = "on motions that no fit has seen" if d.sealed else "on motions held out in turn"
    console.ladder(
        [(step_label(name), error) for name, error in d.errors.items()],
        "of the motion of the fit itself" if d.nothing_held_out else judged,
    )
    head = ["effect", "held-out gain", "s.e.", "statistic", "error before", "after", "size (90 % interval)"]
    rows = []
    for e in (*d.ranking[:SHOWN], *(e for e in d.ranking[SHOWN:] if e.use in d.uses)):
        after = e.error_after if e.refined else None
        rows.append([e.use, e.elpd_gain, e.elpd_se, e.statistic, e.error_before, after, e.sizes_in_words()])
    if rows:
        console.table(f"{d.model}: candidates, best first", head, rows)
    for e in (e for e in d.ranking if e.refined):
        alike = f"; looks like {', '.join(e.confused_with)}" if e.confused_with else ""
        print(f"  {e.use}: {'accepted' if e.accepted else 'not accepted: ' + e.reason}{alike}")
    if d.detectable:
        console.table(detectable.TITLE, detectable.HEAD, detectable.rows(d.detectable))
    print(f"{d.verdict}: {d.statement}")
    for claim in () if d.to_mend else d.claims:  # nothing was tried
        print(f"  {claim}")
    if d.untestable:
        print(f"  not testable with these rollouts: {', '.join(d.untestable)}")
    for line in excitation.advice(d.next_motions):
        print(f"  {line}")
    for command in dict.fromkeys(m.command for m in excitation.best(d.next_motions) if m.command):
        print(f"next: {command}")
    part = next((e.use for e in d.ranking if e.accepted), "") if d.verdict == OUTSIDE_LIBRARY else ""
    if part and not added and not objection(d.to_json(), part):
        print(f"next: ./tcbi add {part} --model {d.model}              # explains a part; then diagnose that version")
    accepted = [e for e in d.ranking if e.accepted]
    if not added and d.verdict == CANNOT_TELL and not d.unsteady and (tried := _beside(accepted)):
        print(f"next: ./tcbi diagnose BAG… --add --model {d.model}              # {tried}")
    fitted = [e.use for e in d.ranking if e.refined]
    if not added and d.uses and d.uses[0] in fitted and not objection(d.to_json(), d.uses[0]):
        sure = d.verdict == EFFECT
        trial = "" if sure else "              # to try it: it is not certain"
        print(f"next: ./tcbi add {d.uses[0]} --model {d.model}{trial}")
    for use in (use for use in d.uses if use not in fitted):
        print(f"next: ./tcbi add {use} --model {d.model} --prior")
    print(f"report: {path} ({d.seconds:.0f} s)")


def _beside(accepted: "list[Evidence]") -> str:
    """What --add would try where no single effect is named, or ""."""
    if len(accepted) > 1:
        return "tries each of them beside the other: both may be missing"
    partly = accepted and accepted[0].explains_little
    return f"looks for another one beside {accepted[0].use}: both may be missing" if partly else ""


def _print_steps(found: "list[Round]") -> None:
    """The error with each effect added, and why the search ended."""
    from tcbi_infer.diagnose.rounds import steps

    console.table("error over the noise floor, motions held out", ["model", "error / noise floor"], steps(found))
    last = found[-1]
    print(f"the search ended: {last.ending}")
    if any(one.added for one in found):
        print(f"next: ./tcbi history BAG… --rig {last.model.rig}              # on rollouts that no fit has seen")
