"""`./tcbi infer`: posterior of a model's parameters from bags, saved as a new model version."""

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import at_least, seed, timestep
from tcbi_bringup.commands import console
from tcbi_bringup.errors import WrongCallError
from tcbi_contract.wording import with_unit

if TYPE_CHECKING:
    from tcbi_infer.tcbi.advice import Advice
    from tcbi_infer.tcbi.driver import Progress
    from tcbi_infer.tcbi.method import Method
    from tcbi_infer.tcbi.problem import Problem
    from tcbi_infer.tcbi.result import Estimate, Result

SUMMARY = "Infer a model's parameters from bags (task-consistent Bayesian inference) and save them as a new version."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi infer rollouts/*                              # the latest model, calibrated",
        "./tcbi infer rollouts/* --model hexapod-v1 --json",
        "./tcbi infer rollouts/* --method paper               # Algorithm 1 as published",
        "./tcbi infer rollouts/* --generations 12             # a narrower posterior, if the data allow it",
        "./tcbi infer rollouts/* --advise                     # and what to record for what they do not tell",
        "./tcbi infer rollouts/* --method simopt              # a method to compare with",
        "./tcbi infer rollouts/* --method paper --set alpha=5 # a setting of the method's own",
        "./tcbi infer rollouts/* --workers ray:HOST:6379      # on a Ray cluster (docs/scale.md)",
    )
    console.add_bags(parser)
    parser.add_argument(
        "--method",
        default="calibrated",
        help="calibrated (default) or paper: TCBI; to compare with: prior, rejection, abc_smc, simopt, bayesopt, npe "
        "(docs/baselines.md)",
    )
    console.add_model(parser, "model version whose parameters are inferred")
    parser.add_argument(
        "--particles", type=at_least(10), help="simulated in each generation, at least 10 (default: 50)"
    )
    parser.add_argument("--generations", type=at_least(1), help="at most (default: 6, paper 15)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        type=_setting,
        metavar="NAME=VALUE",
        help="a setting of the method's own, such as alpha=5 of paper; may be repeated",
    )
    parser.add_argument(
        "--rollouts", type=at_least(1), help="use the first so many of the bags' rollouts (default: all)"
    )
    parser.add_argument(
        "--statistics",
        help="commas; instead of the method's own (`--method paper` with `reward` is the ablation); +NAME adds to "
        "them; joint_motion and body_motion are compared in time, not as distributions",
    )
    parser.add_argument(
        "--divergence", default="js", help="of TCBI: js (default), js_nearest, wasserstein, mmd, or one of your own"
    )
    parser.add_argument(
        "--loop",
        choices=("auto", "open", "acting", "closed"),
        help="open: the recorded commands are replayed; closed: the policies act on the simulated robot; acting "
        "(default of --method paper): trained policies at hand act; auto (default): as acting, but walks and noisy "
        "readings are replayed",
    )
    parser.add_argument(
        "--prior",
        choices=("flat", "model"),
        default="flat",
        help="flat (default); model: go on from what the model version says, with rollouts that it has not seen",
    )
    parser.add_argument(
        "--timestep",
        type=timestep,
        help="s at most, of the simulation whose parameters are wanted (default: 0.005, corrected to 0.002)",
    )
    parser.add_argument("--threads", type=at_least(0), default=0, help="0 (default) for all processors")
    parser.add_argument("--seed", type=seed, default=0, help="of everything that is drawn (default: 0)")
    parser.add_argument(
        "--truth",
        action="append",
        default=[],
        type=_setting,
        metavar="NAME=VALUE",
        help="a parameter's true value, where it is known: its error is shown; may be repeated",
    )
    parser.add_argument(
        "--advise",
        action="store_true",
        help="then simulate motions that could be recorded, and say for each parameter that the data do not identify "
        "which of them would tell it; takes a minute or two for the hexapod",
    )
    console.add_workers(parser)
    console.add_report(parser)
    console.add_store(parser)
    console.add_json(parser)


def _setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number, such as alpha=5")
    return name.strip(), number


def run(args: argparse.Namespace) -> int:
    """Read, infer, save, print."""
    from tcbi_infer import posterior
    from tcbi_infer.report import Report, add_inference, add_kept_ladder
    from tcbi_infer.tcbi.advice import caution, hindrance
    from tcbi_infer.tcbi.driver import Interrupted, infer
    from tcbi_infer.tcbi.method import find_method
    from tcbi_infer.tcbi.problem import Problem
    from tcbi_sim.store import ModelStore

    method, store = find_method(args.method), ModelStore(args.store)
    if args.statistics is not None and not args.statistics.strip(" ,"):
        raise WrongCallError(f"--statistics: got {args.statistics!r}, allowed are names with commas, or +names")
    if args.statistics and not method.by_task:
        raise WrongCallError(f"method {method.name} looks at trajectories, not at statistics; leave --statistics out")
    if args.advise and not method.judges:
        raise WrongCallError(f"method {method.name} does not judge what the data tell; leave --advise out")
    measurements = console.read_bags(args)[: args.rollouts]
    console.note_findings(measurements)
    model = store.load(args.model, measurements[0].rig)
    truth = _known(args.truth, model.names)
    problem = Problem.of(
        model,
        measurements,
        statistics=_statistics(args.statistics or "", method.statistics),
        divergence_name=args.divergence,
        loop=args.loop or method.loop,
        prior=args.prior,
        policies=store.root,
        timestep=args.timestep,
        threads=args.threads,
        seed=args.seed,
        by_task=method.by_task,
    )
    console.note(f"{len(problem.rollout_ids)} rollouts, model {model.version}, method {method.name}")
    given = {"particles": args.particles, "generations": args.generations}
    settings = {**dict(args.set), **{name: value for name, value in given.items() if value is not None}}
    try:
        with console.progress("inferring", total=settings.get("generations")) as advance:
            result = infer(
                problem,
                method.name,
                seed=args.seed,
                folder=store.folder("runs"),
                watch=_watcher(advance, model.names),
                **settings,
            )
    except Interrupted as e:
        console.note(str(e))
        raise KeyboardInterrupt from e
    saved = posterior.save(store, result)
    for line in result.warnings:
        console.note(line)
    advice = _advice(problem, result) if args.advise else None
    if not args.json:
        _print(result, method, saved.version)
        _print_truth(result, truth)
    report = Report(f"What {saved.version} knows", f"Posterior of {model.version}, inferred by {method.name}.")
    add_kept_ladder(report, model, store.history(model.rig))
    add_inference(report, result, method, truth, advice)
    path = report.write(args.report or store.models / saved.version / "inference.html")
    if args.json:
        advised: dict[str, Any] = {} if advice is None else {"advice": [a.as_json() for a in advice]}
        if advice:
            advised["advice_caution"] = caution(result)
        beside = (
            {"truth": [beside_truth(e, truth[e.name]) for e in result.estimates if e.name in truth]} if truth else {}
        )
        console.emit({**as_json(result, method, saved.version), **beside, **advised, "report": str(path)})
    else:
        unknown = [e.name for e in result.estimates if not e.identified]
        if method.judges and unknown and advice is None and not hindrance(result):
            print(f"next: the same with --advise says which motions would tell {', '.join(unknown)}")
        for a in advice or ():
            print(a.line())
        if advice and (line := caution(result)):
            console.note(line)
        print(f"report: {path}")
    return 0


def _advice(problem: "Problem", result: "Result") -> "tuple[Advice, ...]":
    from tcbi_infer.tcbi.advice import advise, hindrance

    if all(e.identified for e in result.estimates):
        console.note("the data identify every parameter; nothing needs to be recorded for them")
        return ()
    if why := hindrance(result):
        console.note(why)
        return ()
    with console.progress("trying motions", total=1.0) as advance:
        return advise(problem, result, lambda share, motion: advance(done=share, note=motion))


def _known(truth: list[tuple[str, float]], names: tuple[str, ...]) -> dict[str, float]:
    from tcbi_sim.errors import UnknownNameError

    for name, _ in truth:
        if name not in names:
            raise UnknownNameError("parameter", name, names)
    return dict(truth)


def _statistics(given: str, own: tuple[str, ...]) -> tuple[str, ...]:
    """Those named, after the method's own where the list begins with +."""
    named = tuple(name.strip() for name in given.lstrip("+").split(",") if name.strip())
    return tuple(dict.fromkeys((*own, *named))) if given.startswith("+") or not named else named


def as_json(result: "Result", method: "Method", version: str) -> dict[str, Any]:
    """The contract's object, and a little more."""
    from tcbi_infer.report.inference import identifiability

    return {
        "model": version,
        "parent": result.model.version,
        "method": result.method,
        "task": result.task,
        "prior": "flat" if result.prior is None else result.model.version,
        "fits": result.fits if method.judges else None,
        "parameters": [
            {**e.as_json(), "identifiability": identifiability(e, result, method)} for e in result.estimates
        ],
        "ess": result.ess,
        "simulations": result.simulations,
        "seconds": result.seconds,
        "generations": len(result.generations),
        "converged": result.converged,
        "closed_loop": result.closed_loop,
        "rollouts": result.rollouts,
        "divergence": result.divergence,
        "settings": result.settings,
        "warnings": result.warnings,
    }


def beside_truth(estimate: "Estimate", truth: float) -> dict[str, Any]:
    """How far a parameter's mean is from what is true, in its unit, and whether the 90 % interval holds it."""
    inside = estimate.low90 <= truth <= estimate.high90
    return {
        "name": estimate.name,
        "unit": estimate.unit,
        "truth": truth,
        "error": estimate.mean - truth,
        "inside": inside,
    }


def _print_truth(result: "Result", truth: dict[str, float]) -> None:
    for p in result.model.parameters:
        if p.name in truth and not p.low <= truth[p.name] <= p.high:
            prior = with_unit(f"{p.low:g} to {p.high:g}", p.unit)
            print(f"{p.name}: the truth {truth[p.name]:g} lies outside the prior, {prior}")
    found = [beside_truth(e, truth[e.name]) for e in result.estimates if e.name in truth]
    if found:
        rows = [[f["name"], f["unit"], f["truth"], f["error"], "yes" if f["inside"] else "no"] for f in found]
        console.table(
            "beside the truth", ["parameter", "unit", "truth", "error of the mean", "in the 90 % interval?"], rows
        )


def _watcher(advance: Callable[..., None], names: tuple[str, ...]) -> Callable[["Progress"], None]:
    """Shows progress, and says first where an earlier run left off."""
    begun = False

    def watch(p: "Progress") -> None:
        nonlocal begun
        done = p.generation - 1 + p.share
        if not begun and done >= 1:
            console.note(f"goes on after generation {done:.0f}, where an earlier run was stopped")
        begun = True
        advance(done=done, total=p.generations, note=_state(p, names))

    return watch


def _state(progress: "Progress", names: tuple[str, ...]) -> str:
    if progress.stage:
        return progress.stage
    if progress.ess != progress.ess:  # NaN: no generation is done yet
        return f"generation {progress.generation}"
    known = ", ".join(f"{n} {m:.3g} ± {s:.2g}" for n, m, s in zip(names, progress.mean, progress.sd, strict=True))
    return f"generation {progress.generation}, {progress.ess:.0f} effective particles, {known}"


def _print(result: "Result", method: "Method", version: str) -> None:
    from tcbi_infer.report.inference import HEAD, posterior_rows
    from tcbi_infer.tcbi.result import LEAST_ESS

    title = f"{version}: posterior of {result.model.version}, method {method.name}"
    console.table(title, HEAD, posterior_rows(result, method))
    print(
        f"{result.simulations} rollouts simulated in {len(result.generations)} generations, {result.seconds:.0f} s, "
        + (
            f"{int(result.ess)} effective particles, "
            if method.judges
            else f"a posterior of {result.ess:.0f} particles, "
        )
        + ("converged" if result.converged else "stopped by the number of generations")
    )
    if method.judges and result.ess < LEAST_ESS:
        share = result.settings.get("least_ess")  # of the particles, that stay effective
        enough = f" (--particles {math.ceil(LEAST_ESS / share)} or more)" if share else ""
        print(f"fewer than {LEAST_ESS} effective particles tell nothing: more particles{enough} or generations do")
    if not any(e.identified for e in result.estimates):
        beyond = "" if result.prior is None else f" beyond what {result.model.version} says"
        nothing = f"nothing is identified{beyond}, and " if method.judges else ""
        print(f"{nothing}{version} is the newest version now; ./tcbi model {version} --delete undoes that")
    if method.caveat:
        print(method.caveat)
