"""The sections that a comparison contributes to a report: ladder, guards, where the error lives, every signal."""

from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.comparison import Comparison
from tcbi_infer.compare.ladder import Rung, explained
from tcbi_infer.compare.locate import worst_moments
from tcbi_infer.compare.scorer import SignalError
from tcbi_infer.compare.signals import JOINT
from tcbi_infer.report import plots
from tcbi_infer.report.page import Figure, Report, Section, Table
from tcbi_infer.report.sections import add_ladder

WORST_S = 1.5  # s, length of a moment shown
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
    headline = (
        f"Model {c.model} errs by {c.error_over_floor:.1f} times the noise floor on {len(c.rollouts)} "
        f"rollout{'s' if len(c.rollouts) != 1 else ''}."
    )
    tone = "good" if c.error_over_floor < 1.5 else "warn"
    report.add(Section("Prediction against measurement", verdict=headline, tone=tone, text=[c.floor.statement]))
    if c.guards:
        text = ["Before any figure is believed: these findings may explain the error without any physics."]
        report.add(Section("About the recording", text=text, notes=c.guards))
    if rungs:
        errors = [
            (r.label + (" (fitted to some of these)" if r.fitted_here else ""), r.error_over_floor) for r in rungs
        ]
        add_ladder(report, errors, told(rungs), c.floor.from_replicates)
    if c.where:
        report.add(Section("Where the error lives", notes=[f.statement for f in c.where], figures=_worst(c, after)))
    report.add(_figures_of("Every signal", c.signals))
    if c.statistics:
        report.add(_figures_of("What the task is about", c.statistics))


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
        f"has gone; {100 * (1 - share):.0f} % is left unexplained."
    )


def _figures_of(title: str, errors: Sequence[SignalError]) -> Section:
    rows = [[e.name, e.unit, e.error, e.noise_floor, e.ratio, e.coverage90, e.crps, e.floor_from] for e in errors]
    shown = [e for e in errors if np.isfinite(e.ratio)]
    bars = Figure(plots.signal_bars([e.name for e in shown], [e.ratio for e in shown]), title + ".", wide=True)
    return Section(title, figures=[bars] if shown else [], table=Table(HEAD, rows, f"{title} in figures"), folded=True)


def _worst(c: Comparison, after: Comparison | None, count: int = 4) -> list[Figure]:
    layout, replay = c.replay.layout, c.replay
    joints = layout.where(JOINT)
    span = round(WORST_S * layout.rate)
    firsts = [g.members[0] for g in replay.replicates]  # replicates would show the same moment again
    residual = (replay.measured - c.predicted)[firsts]
    figures = []
    for s, t, i in worst_moments(residual, c.floor.values, joints, count, span):
        r = firsts[s]
        cut = slice(t, t + span)
        channel = layout.channels[i]
        other = after.predicted[r, cut, i] if after is not None and after.rollouts == c.rollouts else None
        svg = plots.overlay(
            replay.time[cut],
            replay.measured[r, cut, i],
            c.predicted[r, cut, i],
            c.low[r, cut, i],
            c.high[r, cut, i],
            f"{channel.name} / {channel.group.unit}",
            other,
        )
        figures.append(
            Figure(svg, f"One of the worst moments: {channel.name} in rollout {replay.measurements[r].rollout_id}.")
        )
    return figures
