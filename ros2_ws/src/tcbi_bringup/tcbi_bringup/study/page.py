"""The study's report: Tables 3 to 6 and Figures 6 to 13 of the paper, on one HTML page."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator

from tcbi_bringup.demo.plan import recordings
from tcbi_bringup.study import tables
from tcbi_bringup.study.plan import CONTESTANTS, EFFECT, LABELS, WINNER, Plan
from tcbi_bringup.study.tables import ENOUGH, PARAMETERS, Findings
from tcbi_contract.wording import counted
from tcbi_infer.report import Report, Section, Table
from tcbi_infer.report.page import Figure
from tcbi_infer.report.plots import INK, STYLE, WIDE, canvas, to_svg

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c949e", "#b8a800")
SHOWN = {"inclination_deg": 2, "distance_cm": 1, "divergence_nats": 3}  # digits
LEAD = (
    "Each emulated robot has its own friction, mass, servo stiffness and a hidden effect, and its own physics. A first "
    "policy collected rollouts; every method inferred the parameters from the same rollouts with the same number of "
    "simulations at most (fixed randomisation takes the prior as it stands, and a method may converge early); the "
    "policy was retrained once on each posterior with the same budget and deployed on the robot in the same scenarios. "
    "All that came out is shown, whoever wins."
)
EXTRA = (
    " One contestant knows more than the others: {label} also had the recordings of the diagnosis, {motions} of "
    "{length:g} s from each robot. It stands only on the robots where an effect was added; elsewhere it is {rival}."
)
WELCH = (
    "Welch's t-test over all rollouts, as the paper has it. It knows neither that rollouts on one robot resemble one "
    "another, which makes its p values too small with few robots, nor that all methods met the same scenarios on the "
    "same robots, which makes them too large where robots or scenarios differ much: the intervals know both. Each "
    "policy is one training: what another seed of the training would have changed is in no interval and no p value. "
    "Where the difference of the divergence is positive, TCBI's model is further from the robot."
)
BAND = "Mean over robots, with its 95 % interval as a band; with fewer than three, a thin line for each robot."
NONE_OF_FEW = "Intervals are 95 %, Student's t over robots: with fewer than three robots there is none."
CAPTION_OF_TIME = "Figure 11: wall time of a generation. Median of each robot's generations, mean over robots, 95 %"
UNDER_NOISE = (
    "return under noise on what the policy sees. Bands are 95 %; with fewer than three rollouts on each of fewer than "
    "three robots there is none."
)
ONE_BY_ONE = (
    "Pieces of work run one after another, so the sum is how long the study ran, without what was lost with pieces "
    "that were cut off."
)
WIDTH = (
    "A smaller variance alone is no merit: a method may be narrow and wrong, which the error and the share of "
    "intervals that hold the truth tell."
)


def write(findings: Findings, path: Path) -> Path:
    """Write the report, and its figures to a folder beside it; returns the report's path."""
    report = Report("Does it transfer?", lead(findings.plan))
    data = tables.everything(findings)
    report.add(Section("In short", notes=[*_short(findings, data), *data["notes"]]))
    for task in findings.plan.tasks:
        if findings.names(task):
            _performance(report, findings, task, data["tasks"][task])
        if data["tasks"][task]["variance_reduction"]:
            _inference(report, findings, task, data["tasks"][task])
    _times(report, data)
    report.write_figures(path.parent / "figures")
    return report.write(path)


def lead(plan: Plan) -> str:
    """What was done, and who had which data."""
    if not any(CONTESTANTS[name].with_effect for name in plan.contestants):
        return LEAD
    had = plan.diagnosis
    motions = counted(len(recordings(had.motions, had.repeated)), "motion")
    return LEAD + EXTRA.format(label=LABELS[EFFECT], motions=motions, length=had.motion_s, rival=LABELS[WINNER])


def _short(findings: Findings, data: dict[str, Any]) -> list[str]:
    lines = []
    for task, found in data["tasks"].items():
        most = max((row["robots"] for row in found["performance"]), default=0)
        ranked = sorted((r for r in found["performance"] if r["robots"] == most), key=lambda row: -row["return"])
        if ranked:
            best = ", ".join(f"{row['label']} {row['return']:.0f}" for row in ranked)
            lines.append(f"{task}, mean return: {best}.")
        lines += [
            f"{task}: {LABELS[WINNER]} against {row['label']} on the same robots: {row['gain_returns']:+.0f} (95 %: "
            f"{range_of(row, 'gain_returns')})."
            for row in found["comparisons"]
            if row["robots"] < most and row["name"] != EFFECT
        ]
        effect = found["effect"]
        if effect:
            lines.append(
                f"{task}: with the diagnosed effect in the model the return is {effect['with']:.0f} against "
                f"{effect['without']:.0f} without, a gain of {effect['gain']:.0f} (95 %: {range_of(effect, 'gain')}) "
                f"on {effect['robots']} of {counted(len(findings.robots), 'robot')}, those where one was named; on "
                f"{effect['right']} of them it is the one that is hidden, at its place."
            )
    lines.append(
        f"Intervals are 95 %, Student's t over robots. Where a row stands on fewer than {ENOUGH}, they come from the "
        "scatter of the rollouts on each and say nothing of other robots."
    )
    return lines


def _performance(report: Report, findings: Findings, task: str, found: dict[str, Any]) -> None:
    rows = found["performance"]
    head = [
        "policy retrained on",
        "return",
        "95 %",
        "final inclination / deg",
        "distance / cm",
        "divergence / nats",
        "n",
    ]
    cells = [
        [r["label"], _spread(r, "return", 0), range_of(r, "return"),
         *(_spread(r, key, digits) for key, digits in SHOWN.items()), r["rollouts"]]
        for r in rows
    ]  # fmt: skip
    number = {"balance": "Table 4", "forward": "Table 5"}.get(task, "Performance")
    report.add(
        Section(f"{task}: performance on the robot ({number})", table=Table(head, cells, "mean ± standard deviation"))
    )
    welch = [
        [r["label"], r.get("gain_returns"), range_of(r, "gain_returns"), _p(r, "p_returns"), _p(r, "p_returns_holm"),
         r.get("gain_divergence"), _p(r, "p_divergence"), _p(r, "p_divergence_holm")]
        for r in found["comparisons"]
    ]  # fmt: skip
    head = [
        f"{LABELS[WINNER]} against",
        "gain in return",
        "95 %",
        "p",
        "p (Holm)",
        "difference of divergence",
        "p",
        "p (Holm)",
    ]
    spread = {r["label"]: np.concatenate(list(findings.values(task, r["name"], "divergence").values())) for r in rows}
    caption = f"Figure {9 if task == 'balance' else 10}: divergence with each policy"
    drawn = boxes(spread, "divergence of rewards, robot to simulation / nats")
    shown = [Figure(drawn, caption, True, f"{task}_divergence")]
    if found["noise"]:
        shown.append(
            Figure(
                lines_of_noise(found["noise"]),
                f"Figure {12 if task == 'balance' else 13}: {UNDER_NOISE}",
                True,
                f"{task}_noise",
            )
        )
    report.add(Section(f"{task}: who differs (Table 6)", text=[WELCH], table=Table(head, welch), figures=shown))


def _inference(report: Report, findings: Findings, task: str, found: dict[str, Any]) -> None:
    head = [
        "method",
        "parameter",
        "variance less than prior",
        "95 %",
        "error of the mean",
        "95 %",
        "truth inside 90 %",
        "effective particles",
    ]
    rows = [
        [r["label"], r["parameter"],
         f"{r['variance_reduction']:z.0%}", range_of(r, "variance_reduction", ".0%"),
         f"{r['relative_error']:.0%}", range_of(r, "relative_error", ".0%"),
         f"{r['truth_in_90']} of {r['robots']}", f"{r['ess']:.0f}"]
        for r in found["variance_reduction"]
    ]  # fmt: skip
    shown = []
    for parameter, number in zip(PARAMETERS, (6, 8, 7), strict=True):
        mine = [r for r in found["progress"] if r["parameter"] == parameter]
        for key, axis, what in (
            ("error", f"(mean − truth) / truth of {parameter}", f"error of the mean of {parameter}, with its sign"),
            ("variance_ratio", f"variance of {parameter} / prior's", f"variance of {parameter}"),
        ):
            drawn, caption = generations(mine, key, axis), f"Figure {number}: {what}, by generation. {BAND}"
            shown.append(Figure(drawn, caption, name=f"{task}_{parameter}_{key}"))
    shown.append(Figure(bars_of_time(found["seconds"]), CAPTION_OF_TIME, True, f"{task}_seconds"))
    table = Table(head, rows, NONE_OF_FEW)
    report.add(Section(f"{task}: inference (Table 3)", text=[WIDTH], table=table, figures=shown))


def _times(report: Report, data: dict[str, Any]) -> None:
    head = ["task", "stage", "pieces done", "wall time / min"]
    rows = [
        [r["task"] or "all", r["stage"], f"{r['done']} of {r['pieces']}", f"{r['wall_s'] / 60:.1f}"]
        for r in data["times"]
    ]
    report.add(Section("What it took", text=[data["took"], ONE_BY_ONE], table=Table(head, rows)))


def _spread(row: dict[str, Any], key: str, digits: int) -> str:
    return f"{row[key]:.{digits}f} ± {row[f'{key}_sd']:.{digits}f}"


def range_of(row: dict[str, Any], key: str, how: str = ".0f") -> str:
    """A row's interval of an entry; a dash where there is none."""
    low, high = (row.get(f"{key}_{side}95", np.nan) for side in ("low", "high"))
    return f"{low:{how}} to {high:{how}}" if np.isfinite(low) else "–"


def _p(row: dict[str, Any], key: str) -> str:
    return f"{row[key]:.2g}" if key in row else "–"


def generations(rows: tables.Rows, key: str, axis: str) -> str:
    """One parameter's error or variance over the generations of each method: a band over robots, or each of a few."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(3.4)
        axes.axhline(0, color=INK, lw=0.6)
        longest = max((r["generation"] for r in rows), default=1)
        for name, color in zip(dict.fromkeys(r["name"] for r in rows), COLORS, strict=False):
            mine = [r for r in rows if r["name"] == name]
            if len(mine) == 1:  # a method without generations is a level for the others
                mine = [mine[0], {**mine[0], "generation": longest}]
            at, mean, low, high = ([r[k] for r in mine] for k in ("generation", key, f"{key}_low95", f"{key}_high95"))
            if np.isfinite(low).all():
                axes.fill_between(at, low, high, color=color, alpha=0.12, lw=0)
            else:
                axes.plot(at, [r[f"{key}_each"] for r in mine], color=color, alpha=0.4, lw=0.5)
            axes.plot(at, mean, "o-", ms=3, lw=1.2, color=color, label=mine[0]["label"])
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("generation")
        axes.set_ylabel(axis)
        figure.legend(fontsize=6, ncols=3, loc="outside lower center")  # the lines cross everywhere
        return to_svg(figure)


def boxes(values: dict[str, np.ndarray], axis: str) -> str:
    """Distributions side by side, by label."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(0.8 + 0.36 * len(values), WIDE)
        axes.boxplot([v[np.isfinite(v)] for v in values.values()], orientation="horizontal", widths=0.6)
        axes.set_yticks(np.arange(1, len(values) + 1), list(values))
        axes.invert_yaxis()
        axes.set_xlabel(axis)
        return to_svg(figure)


def lines_of_noise(rows: tables.Rows) -> str:
    """Return over noise with intervals, a line for each method."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(3.0, WIDE)
        for name, color in zip(dict.fromkeys(r["name"] for r in rows), COLORS, strict=False):
            mine = [r for r in rows if r["name"] == name]
            sigma, mean = ([r[key] for r in mine] for key in ("sigma", "return"))
            axes.fill_between(
                sigma, [r["low95"] for r in mine], [r["high95"] for r in mine], color=color, alpha=0.12, lw=0
            )
            axes.plot(sigma, mean, "o-", ms=3, color=color, label=mine[0]["label"])
        axes.set_xlabel("noise on joint angles and attitude / rad")
        axes.set_ylabel("return")
        figure.legend(fontsize=7, loc="outside right upper")  # the lines cross everywhere
        return to_svg(figure)


def bars_of_time(rows: tables.Rows) -> str:
    """Wall time of a generation of each method."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(0.6 + 0.3 * len(rows), WIDE)
        length, low, high = (np.array([r[f"seconds{k}"] for r in rows]) for k in ("", "_low95", "_high95"))
        around = np.fmax([length - low, high - length], 0)  # 0 for NaN: fewer than three robots have no interval
        axes.barh(np.arange(len(rows)), length, xerr=around, color=COLORS[0], ecolor=INK, height=0.6)
        axes.set_yticks(np.arange(len(rows)), [r["label"] for r in rows])
        axes.invert_yaxis()
        axes.set_xlabel("wall time of a generation / s")
        return to_svg(figure)
