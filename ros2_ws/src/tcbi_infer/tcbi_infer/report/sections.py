"""The sections that diagnosis, versions and history contribute to a report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_contract.wording import with_unit
from tcbi_infer.compare.history import history
from tcbi_infer.compare.ladder import lineage
from tcbi_infer.compare.versions import Difference, Interval, intervals
from tcbi_infer.diagnose import detectable, excitation
from tcbi_infer.diagnose.adopt import doubt
from tcbi_infer.diagnose.evidence import EFFECT, Diagnosis, Evidence, step_label
from tcbi_infer.report import plots
from tcbi_infer.report.explained import agreement_section, leftover_section
from tcbi_infer.report.page import Figure, Report, Section, Table
from tcbi_sim.model import Model


def add_ladder(
    report: Report,
    errors: Sequence[tuple[str, float]],
    text: str = "",
    repeated: bool | None = None,
    title: str = "How wrong is the model?",
) -> None:
    """The error ladder: noise floor, then each model, then what is left.

    Args:
      report: that it is added to.
      errors: label and error over noise floor of each model.
      text: one paragraph more.
      repeated: whether the floor comes from repeats of the same commands, else it is estimated; None: not known.
      title: of the section.
    """
    explain, figure = ladder_figure(errors, repeated)
    report.add(Section(title, text=[explain, *([text] if text else [])], figures=[figure]))


def ladder_figure(errors: Sequence[tuple[str, float]], repeated: bool | None) -> tuple[str, Figure]:
    """What the bars of a ladder mean, and the ladder; arguments as of `add_ladder`."""
    itself = {
        True: "in multiples of how much the robot differs from itself when it repeats a motion",
        False: "in multiples of the noise floor, which is estimated here, since no motion was repeated",
        None: "in multiples of the noise floor",
    }[repeated]
    explain = (
        f"Each bar is how far the prediction is from the measurement, joints and attitude together, {itself}. 1 is as "
        "good as any model can be."
    )
    return explain, Figure(plots.ladder(errors, repeated), "Error over noise floor, joints and attitude.", wide=True)


def add_kept_ladder(report: Report, version: Model, models: Sequence[Model]) -> None:
    """The ladder up to a version, of the errors that the diagnoses kept, or that none was measured."""
    line = history(lineage(version, models))
    errors = [(f"{v.model} ({', '.join(v.effects) or 'no effect'})", v.error_over_floor) for v in line]
    known = [(label, error) for label, error in errors if error is not None]
    title = f"The way to {version.version}"
    if not known:
        report.add(Section(title, ["No error was measured on the way here; ./tcbi history BAG… measures it."]))
        return
    text = "Each as a diagnosis kept it, on rollouts that its fits had not seen; `history` measures all on the same."
    add_ladder(report, known, text, title=title)


def add_diagnosis(report: Report, diagnosis: Diagnosis, earlier: Sequence[tuple[str, float]] = ()) -> None:
    """The verdict, the ladder, the ranking, the fitted sizes, what the verdict rests on.

    Args:
      report: that it is added to.
      diagnosis: what was found.
      earlier: steps of the ladder that led to the model diagnosed: label and error over the noise floor.
    """
    d = diagnosis
    tone = "good" if d.reassuring else {EFFECT: "warn"}.get(d.verdict, "neutral")
    sizes = Table(detectable.HEAD, detectable.rows(d.detectable), detectable.TITLE) if d.detectable else None
    own = [(step_label(k), v) for k, v in d.errors.items()]
    explain, figure = ladder_figure([*earlier, *own], d.floor_from_replicates)
    if d.guards:
        report.add(Section("About the recording", notes=d.guards))
    report.add(Section(d.headline, verdict=d.statement, tone=tone, text=[explain], figures=[figure]))
    report.add(Section("What the verdict rests on", notes=d.claims, table=sizes, folded=True))
    if d.ranking:
        report.add(_ranking(d))
    if d.moments:
        report.add(_moments(d))
    named = [e for e in d.ranking if e.use in d.uses and e.parameters]
    if named:
        report.add(_sizes(named))
    told = d.uses[0] if d.uses and d.uses[0] in d.agreement else ""
    if d.agreement.get(told):
        report.add(agreement_section(d.agreement[told], told))
    if d.leftover:
        report.add(leftover_section(d.leftover))
    if d.next_motions:
        report.add(_next_motions(d))
    if d.untestable:
        text = ["In these rollouts the following change nothing that can be measured, so nothing is said about them."]
        report.add(Section("What these rollouts cannot test", text=text, notes=d.untestable))


def _next_motions(d: Diagnosis) -> Section:
    names = {m.between: " against ".join(name or "a model without it" for name in m.between) for m in d.next_motions}
    rows = [[names[m.between], m.motion, m.description, m.nats, m.duration_s, m.command] for m in d.next_motions]
    return Section(
        "What to record next",
        text=[
            "Both models were simulated on motions that are ready to be recorded, each in turn as the truth, the other "
            "one refitted. The evidence is the log-likelihood ratio to expect, whichever is right."
        ],
        notes=excitation.advice(d.next_motions),
        table=Table(["to tell apart", "motion", "what it does", "evidence / nats", "length / s", "command"], rows),
        folded=True,
    )


def _ranking(d: Diagnosis, most: int = 12) -> Section:
    shown = [e for e in d.ranking if np.isfinite(e.elpd_gain)][:most]
    labels = [e.use for e in shown]
    chosen = [e.use in d.uses for e in shown]
    svg = plots.bars(labels, [e.elpd_gain for e in shown], [e.elpd_se for e in shown], chosen, "held-out gain / nats")
    rows = [
        [
            e.use,
            e.elpd_gain,
            e.elpd_se,
            e.statistic,
            e.error_before,
            e.error_after,
            e.sizes_in_words(),
            "yes" if e.accepted else e.reason,
            ", ".join(e.confused_with),
        ]
        for e in d.ranking
    ]
    head = [
        "effect",
        "gain",
        "s.e.",
        "statistic",
        "error before",
        "after",
        "size (90 % interval)",
        "accepted?",
        "looks like",
    ]
    text = [
        f"{'Not every' if d.untried else 'Every'} effect of the library was tried. A bar is how much better motions "
        "are predicted that the fit had not seen; the whisker is its standard error between kinds of motion. What an "
        "effect looks like has a signal of the same shape; the verdict tells them apart where their gains differ."
    ]
    if np.isfinite(d.threshold):
        text.append(
            "The statistic is the sum of the square roots of these gains, kind by kind, over its standard error. What "
            f"searching so many effects finds by luck is {d.threshold:.1f} here, which an effect must beat."
        )
    return Section(
        "Which effect explains the error?",
        text=text,
        figures=[Figure(svg, "Held-out gain of each candidate; in colour what the verdict names.", wide=True)],
        table=Table(head, rows, "All candidates in figures"),
        folded=True,
    )


def _moments(d: Diagnosis) -> Section:
    figures = []
    for m in d.moments:
        half = 1.645 * m.floor
        svg = plots.overlay(
            m.time,
            m.measured,
            m.before,
            m.before - half,
            m.before + half,
            f"{m.signal} / {m.unit}",
            m.after.get(d.ranking[0].use),
            band="noise floor",
        )
        figures.append(Figure(svg, f"{m.signal} in rollout {m.rollout}."))
    return Section(
        "The worst moments before and after",
        text=[
            "Where the model without any new effect fails worst, and what the best candidate "
            f"({d.ranking[0].use}) makes of it. Both were fitted to "
            f"{'the motion shown' if d.nothing_held_out else 'other kinds of motion than the one shown'}. The band "
            "is the noise floor.",
        ],
        figures=figures,
    )


def _sizes(named: Sequence[Evidence]) -> Section:
    sizes = [p for evidence in named for p in evidence.parameters]
    figures = [_size(p.name, p.unit, p.value, (p.low90, p.high90), p.null, (p.low, p.high)) for p in sizes]
    return Section(
        "How large is it?",
        text=[
            "The dot is the fitted value, the thick line its 90 % interval, the grey one the range that was searched; "
            "the cross is where the effect would vanish."
        ],
        figures=figures,
    )


def _size(
    name: str, unit: str, value: float, interval: tuple[float, float], null: float | None, bounds: tuple[float, float]
) -> Figure:
    svg = plots.interval(name, unit, value, *interval, null, bounds)
    low, high = interval
    return Figure(svg, f"{with_unit(f'{value:.3g}', unit)}, 90 % between {low:.3g} and {high:.3g}.")


def add_version(report: Report, parent: Model, child: Model) -> None:
    """A new version: whether the data asked for it, how the error changes, every parameter before and after."""
    evidence = child.evidence
    if "statement" not in evidence:
        told, tone = "Nothing has been fitted: the new parameters are as wide as their prior.", "neutral"
    elif why := doubt(evidence):
        told, tone = f"The effect is a guess: the diagnosis {why}. {evidence['statement']}", "warn"
    else:
        told, tone = evidence["statement"], "good"
    disagreements = evidence.get("disagreements", [])
    tone = "warn" if disagreements else tone
    report.add(Section(f"{child.version} follows {parent.version}", verdict=told, tone=tone, notes=disagreements))
    if evidence.get("errors"):
        errors = [(step_label(k), np.inf if v is None else v) for k, v in evidence["errors"].items()]
        add_ladder(report, errors, repeated=evidence.get("floor_from_replicates"))
    before = dict(zip(parent.names, _quantiles(parent), strict=True))
    rows = [
        [p.name, p.unit, before.get(p.name, "–"), after]
        for p, after in zip(child.parameters, _quantiles(child), strict=True)
    ]
    head = ["parameter", "unit", f"{parent.version}: mean (5 % to 95 %)", child.version]
    now = intervals(child)
    own = [p for p in child.parameters if p.name not in parent.names]
    figures = [
        _size(p.name, p.unit, i.mean, (i.low90, i.high90), p.null, (p.low, p.high))
        for p, i in ((p, now[p.name]) for p in own)
    ]
    text = [f"Joints' own gains, over what these parameters say: {child.joint_gains_told}."]
    report.add(Section("Its parameters", text=text, figures=figures, table=Table(head, rows)))


def add_difference(report: Report, d: Difference) -> None:
    """Two versions: effects, what each rests on, every parameter before and after."""
    report.add(Section(f"{d.after} beside {d.before}", verdict=d.statement))
    grounds = (d.grounds_before, d.grounds_after)
    rows: list[list[Any]] = [
        ["effects that the other lacks", ", ".join(d.effects_removed) or "none", ", ".join(d.effects_added) or "none"],
        ["made by", *(g.kind for g in grounds)],
        ["what it says", *(g.statement or "–" for g in grounds)],
        ["rollouts that it was fitted to", *(len(g.rollouts) for g in grounds)],
        ["joints' own gains", *(g.joint_gains for g in grounds)],
        ["error over noise floor, held out", *(g.error_over_floor for g in grounds)],
    ]
    text = []
    if d.rollouts_shared:
        text.append(f"{d.rollouts_shared} rollouts went into both.")
    if None not in (d.grounds_before.error_over_floor, d.grounds_after.error_over_floor):
        text.append("The two errors are of the rollouts that each version's own diagnosis held out.")
    report.add(Section("What they rest on", text=text, table=Table(["", d.before, d.after], rows)))
    labels = (d.before, d.after)
    figures = [
        Figure(plots.versions(p.name, p.unit, p.before, p.after, labels), p.name)
        for p in d.parameters
        if p.before and p.after
    ]
    head = ["parameter", "unit", f"{d.before}: mean (5 % to 95 %)", d.after, "overlap", "width after / before"]
    table = [[p.name, p.unit, _span(p.before), _span(p.after), p.overlap, p.width_ratio] for p in d.parameters]
    text = ["Lines are 90 % intervals. The overlap is the share of the shorter one that lies in the other."]
    report.add(Section("Parameters", text=text, figures=figures, table=Table(head, table)))


def _span(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.mean:.3g} ({interval.low90:.3g} to {interval.high90:.3g})"


def _quantiles(model: Model) -> list[str]:
    """Mean and 90 % interval of each parameter under the model's particles."""
    return [_span(interval) for interval in intervals(model).values()]


def add_history(report: Report, rows: Sequence[tuple[str, str, str, float]], repeated: bool | None = None) -> None:
    """Model versions: (version, parent, effects, error over floor); `repeated` as in `add_ladder`."""
    svg = plots.history([r[0] for r in rows], [r[1] for r in rows], [r[3] for r in rows], repeated)
    caption = "Error of each version; 1 is the noise floor. A line joins a version with the one it was made from."
    table = Table(["model", "parent", "effects", "error / noise floor"], rows)
    report.add(Section("Model versions", figures=[Figure(svg, caption, wide=True)], table=table))
