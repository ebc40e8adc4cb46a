"""The sections that a comparison contributes to a report: ladder, guards, where the error lives, every signal."""

from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.comparison import Comparison
from tcbi_infer.compare.findings import Finding, Moment
from tcbi_infer.compare.ladder import Rung, explained
from tcbi_infer.compare.maps import curves, heat, joint_errors
from tcbi_infer.compare.replicates import by_torque
from tcbi_infer.compare.scorer import SignalError
from tcbi_infer.compare.signals import JOINT, reference
from tcbi_infer.compare.worst import MOMENTS
from tcbi_infer.report import plots
from tcbi_infer.report.body import body_figures
from tcbi_infer.report.drawing import Scale, robot
from tcbi_infer.report.maps import curves as condition_plots
from tcbi_infer.report.maps import heat_map
from tcbi_infer.report.page import Figure, Report, Section, Table
from tcbi_infer.report.sections import ladder_figure
from tcbi_sim.rigs import load_rig

HEAD = ("signal", "unit", "error", "noise floor", "ratio", "share inside 90 % band", "CRPS", "floor from")


def add_comparison(
    report: Report, comparison: Comparison, after: Comparison | None = None, rungs: Sequence[Rung] = ()
) -> None:
    """What the recording is worth, the ladder, where the error lives, the worst moments, every signal.

    Args:
      report: that it is added to.
      comparison: what is shown.
      after: of a later version on the same rollouts, shown beside it.
      rungs: the ladder; none where the report has one already.
    """
    c = comparison
    if c.guards:
        text = ["Before any figure is believed: these findings may explain the error without any physics."]
        report.add(Section("About the recording", text=text, notes=c.guards))
    headline = (
        f"Model {c.model} errs by {c.error_over_floor:.1f} times the noise floor on {len(c.rollouts)} "
        f"rollout{'s' if len(c.rollouts) != 1 else ''}."
    )
    tone = "good" if c.error_over_floor < 1.5 else "warn"
    text, figures = [c.floor.statement, *_checked(c)], []
    if rungs:
        mark = "\n(fitted to some of these)"
        errors = [(f"{r.label}{mark * r.fitted_here}", r.error_over_floor) for r in rungs]
        explain, ladder = ladder_figure(errors, c.floor.from_replicates)
        text, figures = [explain, *filter(None, [told(rungs)]), *text], [ladder]
    report.add(Section("Prediction against measurement", verdict=headline, tone=tone, text=text, figures=figures))
    _add_places(report, c, after)
    text = [
        "Where the prediction of joints, attitude and rates departs most, each over its own noise floor. The line is "
        "the prediction at the mean parameters, the band holds 90 % of what the model thinks possible, noise included."
    ]
    worst = _worst(c, after)
    title = "The ten worst moments" if len(worst) == MOMENTS else "The worst moments"
    report.add(Section(title, text=text, figures=worst))
    body = body_figures(c)
    if body:
        text = ["Each where it errs most: the rollout and the seconds around its worst moment."]
        fold = "Measured and predicted " + ", ".join(f.caption.partition(" in ")[0].lower() for f in body)
        report.add(Section("The body", text=text, figures=body, folded_figures=fold))
    if c.statistics:
        report.add(_figures_of("What the task is about", c.statistics, folded=False))
    report.add(_figures_of("Every signal", c.signals, folded=True))


def _checked(c: Comparison) -> list[str]:
    """What of the recording was checked without a finding, and what could not be checked."""
    what = "Stamps and rates" if len(c.unchecked) == len(c.rollouts) else "Clocks, rates, wiring and units"
    return [*([] if c.guards else [f"{what} of the recording were checked: nothing was found."]), *c.not_checked]


def _add_places(report: Report, c: Comparison, after: Comparison | None) -> None:
    """Sentences, the drawing, the map of joints and phases, the plot of each sentence, what the error grows with."""
    attitude = [s.ratio for s in c.signals if s.name in ("roll", "pitch")]
    body = float(np.sqrt(np.mean(np.square(attitude)))) if attitude else float("nan")
    whole = " and the trunk by that of its attitude" * bool(attitude)
    found, errors = heat(c), joint_errors(c)
    scale = Scale.of([*errors.values(), body, *found.values.ravel()])
    figures = [
        Figure(
            robot(load_rig(c.replay.rig), errors, body, scale),
            f"Each part coloured by the error of the joint that moves it{whole}: the darker, the worse.",
            wide=True,
        ),
    ]
    if found.phases:
        caption = "Error over noise floor of each joint in each phase of its motion."
        figures.append(Figure(heat_map(found, scale), caption, wide=True))
    for number, finding in enumerate(c.where, 1):
        if finding.moment is not None:
            figures.append(_shown(c, after, finding, finding.moment, number))
    predicted = np.isfinite(c.replay.measured - c.predicted).any()
    nowhere = "Nowhere more than elsewhere." if predicted else "Not told: the prediction diverged in every rollout."
    sentences = [f.statement for f in c.where] or [nowhere]
    report.add(Section("Where the error lives", notes=sentences, ordered=True, figures=figures))
    drawn = curves(c)
    if drawn:
        figure = Figure(
            condition_plots(drawn),
            "All joints together; bins hold equally many samples, or one value each where values are few. Dashed: "
            "noise floor.",
            wide=True,
        )
        report.add(Section("What the error grows with", figures=[figure]))


def _shown(c: Comparison, after: Comparison | None, finding: Finding, moment: Moment, number: int) -> Figure:
    """The plot that shows a finding, its phase shaded."""
    span = len(moment.inside)
    shaded = f"; {'all of it' if moment.inside.all() else 'shaded:'} {finding.phase}" * bool(finding.phase)
    name = c.replay.layout.channels[moment.channel].name
    rollout = c.replay.measurements[moment.rollout].rollout_id
    svg = _overlay(c, after, moment.rollout, moment.first, moment.channel, span, moment.inside)
    return Figure(svg, f"{number}. {name} in {rollout}{shaded}.")


def told(rungs: Sequence[Rung]) -> str:
    """What the way from the first rung to the last one has explained, in a sentence."""
    if len(rungs) < 2:
        return ""
    share = explained(rungs[0].error_over_floor, rungs[-1].error_over_floor)
    if not np.isfinite(share):
        return ""
    if share < 0:
        return f"{rungs[-1].model} predicts these rollouts worse than {rungs[0].model}."
    return (
        f"From {rungs[0].model} to {rungs[-1].model}, {100 * share:.0f} % of the squared error beyond the noise floor "
        f"has gone; {100 * (1 - share):.0f} % of it remains."
    )


def _figures_of(title: str, errors: Sequence[SignalError], folded: bool) -> Section:
    rows = [[e.name, e.unit, e.error, e.noise_floor, e.ratio, e.coverage90, e.crps, e.floor_from] for e in errors]
    shown = [e for e in errors if np.isfinite(e.ratio)]
    bars = Figure(plots.signal_bars([e.name for e in shown], [e.ratio for e in shown]), title + ".", wide=True)
    return Section(
        title, figures=[bars] if shown else [], table=Table(HEAD, rows, f"{title} in figures"), folded=folded
    )


def _worst(c: Comparison, after: Comparison | None) -> list[Figure]:
    figures = []
    for moment in c.worst:
        r, t, i = moment.index
        span = int(np.sum((c.replay.time >= moment.time) & (c.replay.time <= moment.until)))
        caption = f"{moment.signal} in {moment.rollout}: {moment.error_over_floor:.1f} times the noise floor."
        figures.append(Figure(_overlay(c, after, r, t, i, span), caption))
    return figures


def _overlay(
    c: Comparison, after: Comparison | None, r: int, t: int, i: int, span: int, inside: np.ndarray | None = None
) -> str:
    cut, channel = slice(t, t + span), c.replay.layout.channels[i]
    same = after is not None and after.rollouts == c.rollouts
    return plots.overlay(
        c.replay.time[cut],
        c.replay.shown[r, cut, i],
        c.predicted[r, cut, i],
        c.low[r, cut, i],
        c.high[r, cut, i],
        f"{channel.name} / {channel.group.unit}",
        after.predicted[r, cut, i] if same and after is not None else None,
        inside,
        _command(c, r, i, cut),
    )


def _command(c: Comparison, r: int, i: int, cut: slice) -> np.ndarray | None:
    """(T,) deg that a joint was asked for; None of another signal, and where torques drive."""
    channel, measurement = c.replay.layout.channels[i], c.replay.measurements[r]
    if channel.group is not JOINT or by_torque(measurement):
        return None
    return np.degrees(reference(measurement, c.replay.time[cut])[:, measurement.joint_names.index(channel.name)])
