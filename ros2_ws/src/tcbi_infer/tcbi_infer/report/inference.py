"""What an inference contributes to a report: the posterior beside the prior, and how it came about."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np

from tcbi_infer.report.page import Figure, Report, Section, Table
from tcbi_infer.report.plots import BLUE, GREY, INK, ORANGE, STYLE, canvas, to_svg
from tcbi_infer.tcbi.advice import caution
from tcbi_infer.tcbi.prior import doubtful
from tcbi_infer.tcbi.result import IDENTIFIED_BELOW, LEAST_ESS

if TYPE_CHECKING:
    from tcbi_infer.tcbi.advice import Advice
    from tcbi_infer.tcbi.method import Method
    from tcbi_infer.tcbi.result import Estimate, Result

HEAD = ("parameter", "unit", "mean", "sd", "90 % interval", "variance less than prior", "identified?")
NARROW = (
    "A narrow posterior is not a right one: these curves show what the method did. Only a known truth, or an error on "
    "rollouts that were held out, shows whether it was right."
)
Truth = Mapping[str, float]


def add_inference(
    report: Report,
    result: "Result",
    method: "Method",
    truth: Truth | None = None,
    advice: "Sequence[Advice] | None" = None,
) -> None:
    """Verdict and table, posterior beside prior, generations.

    Args:
      report: to add to.
      result: of an inference.
      method: that inferred.
      truth: values of parameters where they are known.
      advice: what to record for parameters that are not identified; None where nobody asked.
    """
    known = truth or {}
    identified = [e.name for e in result.estimates if e.identified]
    verdict = (
        f"The data identify {', '.join(identified)}." if identified else "No parameter can be said to be identified."
    )
    head, rows, caveat = [*HEAD], posterior_rows(result, method), method.caveat
    text = [
        f"{len(result.rollouts)} rollouts of {result.task}, {result.simulations} simulated in "
        f"{len(result.generations)} generations of the method {result.method}; {int(result.ess)} effective particles.",
        *([f"{caveat[0].upper()}{caveat[1:]}."] if caveat else []),
    ]
    if known:
        head += ["truth", "error", "inside?"]
        rows = [row + _beside(e, known) for row, e in zip(rows, result.estimates, strict=True)]
    tone = "good" if identified else "neutral"
    notes = list(result.warnings)
    report.add(Section("What the rollouts say", text, notes, verdict=verdict, tone=tone, table=Table(head, rows)))
    if advice:
        report.add(_advice(advice, caution(result)))
    figures = [
        Figure(_densities(result, i, known), f"{e.name}: prior and posterior.") for i, e in enumerate(result.estimates)
    ]
    explain = "Grey is the prior, blue the posterior" + (", the dashed line the truth." if known else ".")
    report.add(Section("Posterior beside prior", [explain], figures=figures))
    if result.generations:
        report.add(_generations(result, known))


def _advice(advice: "Sequence[Advice]", why_less: str) -> Section:
    head = ("parameter", "motion", "", "variance left", "would it tell?", "command")
    rows = [(a.parameter, a.motion, a.description, f"{a.left:.0%}", a.tells, a.command) for a in advice]
    text = (
        "For each parameter that the data do not identify, the motion that shows it best among draws of the posterior, "
        "and how much of its variance two recordings of that motion would leave. This comes from simulations of this "
        "model, with as much noise as the rollouts differ from theirs."
    )
    notes = [why_less] if why_less else []
    return Section("What to record next", [text], notes, table=Table(head, rows))


def posterior_rows(result: "Result", method: "Method") -> list[list[Any]]:
    """A row of `HEAD` for each parameter."""
    return [
        [
            e.name,
            e.unit,
            e.mean,
            e.sd,
            f"{e.low90:.3g} to {e.high90:.3g}",
            f"{1 - e.variance_ratio:.0%}",
            identifiability(e, result, method),
        ]
        for e in result.estimates
    ]


def identifiability(estimate: "Estimate", result: "Result", method: "Method") -> str:
    """Whether the data identify a parameter, in a few words."""
    if not method.judges:
        return "not judged by this method"
    if result.fits is None:
        return "cannot say: too few generations"
    if not result.fits:
        return "not identified: the model fits poorly"
    if result.prior is not None and doubtful(result.model):
        return "not identified: the prior is doubtful"
    if result.ess < LEAST_ESS:
        return "cannot say"
    if estimate.identified:
        return "yes"
    if estimate.variance_ratio < IDENTIFIED_BELOW:
        return "not surely"
    return "no: little more than the prior" if result.prior is None else f"little beyond {result.model.version}'s"


def _beside(e: "Estimate", truth: Truth) -> list[Any]:
    at = truth.get(e.name)
    return ["–"] * 3 if at is None else [at, e.mean - at, e.low90 <= at <= e.high90]


def _densities(result: "Result", i: int, truth: Truth) -> str:
    """Histograms of prior and posterior on the parameter's own scale."""
    parameter, e = result.model.parameters[i], result.estimates[i]
    edges = parameter.from_unit(np.linspace(0, 1, 41))
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(1.7)
        share, _ = np.histogram(result.unit[:, i], bins=40, range=(0, 1), weights=np.exp(result.log_weights))
        before = np.full(40, 1 / 40)
        if result.prior is not None:
            before = np.histogram(result.prior[:, i], bins=40, range=(0, 1))[0] / len(result.prior)
        axes.stairs(before, edges, fill=True, color=GREY, alpha=0.35)
        axes.stairs(share, edges, fill=True, color=BLUE, alpha=0.8)
        if e.name in truth:
            axes.axvline(truth[e.name], color=ORANGE, ls="--")
        if parameter.scale == "log":
            axes.set_xscale("log")
        axes.set_yticks([])
        axes.set_xlabel(_labelled(e.name, e.unit))
        return to_svg(figure)


def _generations(result: "Result", truth: Truth) -> Section:
    numbers = [g["generation"] for g in result.generations]
    mean = np.array([g["mean"] for g in result.generations])
    variance = np.array([g["variance"] for g in result.generations])
    figures = []
    for i, e in enumerate(result.estimates):
        curve = _curve(numbers, mean[:, i], np.sqrt(variance[:, i]), e, truth)
        figures.append(Figure(curve, f"Mean of {e.name}, the band one standard deviation on either side."))
        figures.append(Figure(_variance(numbers, variance[:, i], e), f"Variance of {e.name}; dashed, the prior's."))
    head = ["generation", "effective particles", "alpha", *(f"divergence: {s}" for s in result.statistics)]
    head += [f"variance of {e.name} less than prior" for e in result.estimates]
    rows = [
        [g["generation"], g["ess"], g["alpha"], *g["divergence"], *(f"{1 - r:.0%}" for r in g["variance_ratio"])]
        for g in result.generations
    ]
    table = Table(head, rows, "The generations in figures")
    return Section("Over the generations", [NARROW], figures=figures, table=table, folded=True)


def _curve(numbers: list[int], mean: np.ndarray, sd: np.ndarray, e: "Estimate", truth: Truth) -> str:
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(2.0)
        axes.fill_between(numbers, mean - sd, mean + sd, color=BLUE, alpha=0.2, lw=0)
        axes.plot(numbers, mean, "o-", color=BLUE, ms=4)
        if e.name in truth:
            axes.axhline(truth[e.name], color=ORANGE, ls="--", lw=1.2)
        _finish(axes, numbers, _labelled(f"mean of {e.name}", e.unit))
        return to_svg(figure)


def _variance(numbers: list[int], variance: np.ndarray, e: "Estimate") -> str:
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(2.0)
        axes.plot(numbers, variance, "o-", color=BLUE, ms=4)
        axes.axhline(e.prior_sd**2, color=INK, ls="--", lw=0.8)
        axes.set_ylim(bottom=0)
        _finish(axes, numbers, f"variance of {e.name}")
        return to_svg(figure)


def _finish(axes: Any, numbers: list[int], label: str) -> None:
    axes.set_xticks(numbers[:: max(1, len(numbers) // 8)])
    axes.set_xlabel("generation")
    axes.set_title(label, loc="left", fontsize="medium")  # beside a figure this low, a unit would be cut off


def _labelled(name: str, unit: str) -> str:
    return f"{name} / {unit}" if unit not in ("", "1") else name
