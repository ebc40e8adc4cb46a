"""Figures as inline SVG: colours that colour-blind readers tell apart, text in the page's own colour, units on axes."""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg", force=False)
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from tcbi_infer.compare.ladder import unexplained
from tcbi_infer.compare.versions import Interval

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#8c949e"  # Okabe and Ito
INK = "#010203"  # replaced by the page's text colour
WIDTH, WIDE = 4.4, 5.4  # inch; one column on a phone
STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.5,
}


def canvas(height: float, width: float = WIDTH) -> tuple[Canvas, Axes]:
    """A figure with one set of axes."""
    figure = Canvas(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def to_svg(figure: Canvas) -> str:
    """The figure as an SVG element that takes the colour of the text around it."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    unique = f"f{abs(hash(text)) % 10**9:09d}"
    text = re.sub(r'id="([^"]+)"', rf'id="{unique}-\1"', text)  # several figures share a page
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{unique}-", text)


def _times(ratio: float) -> str:
    """An error over the noise floor beside its bar: two digits, and never a power of ten."""
    return f"{ratio:.2g}" if ratio < 99.5 else f"{ratio:,.0f}"


def ladder(errors: Sequence[tuple[str, float]], repeated: bool | None = None) -> str:
    """Error over noise floor of the floor itself, of each model, and what the last one leaves unexplained.

    Args:
      errors: label and error over noise floor of each model.
      repeated: whether the floor comes from repeats of the same commands, else it is estimated; None: not known.
    """
    floor = {True: "the robot against itself", False: "noise floor, estimated", None: "noise floor"}[repeated]
    rest = unexplained(errors[-1][1]) if errors else float("nan")
    bars = [(floor, 1.0, GREY), *((label, value, BLUE) for label, value in errors)]
    bars += [("left unexplained", rest, ORANGE)] if np.isfinite(rest) else []
    with matplotlib.rc_context(STYLE):
        values = np.array([value for _, value, _ in bars])
        figure, axes = canvas(0.55 + 0.36 * len(values), WIDE)
        shown = np.where(np.isfinite(values), values, 0.0)
        axes.barh(np.arange(len(values)), shown, color=[color for *_, color in bars], height=0.62)
        for y, value in enumerate(values):
            if not np.isfinite(value):
                axes.annotate("no prediction: diverged", (0, y), (4, 0), textcoords="offset points", va="center")
                continue
            beyond = max(value, 1.0) if value < 1.2 else value  # clear of the line at 1
            axes.annotate(_times(value), (beyond, y), (4, 0), textcoords="offset points", va="center", ha="left")
        axes.axvline(1.0, color=GREY, lw=0.8, ls="--")
        axes.set_yticks(np.arange(len(values)), [label for label, *_ in bars])
        axes.invert_yaxis()
        axes.set_xlim(0, float(shown.max()) * 1.12)
        axes.set_xlabel("error / noise floor")
        axes.tick_params(axis="y", length=0)
        return to_svg(figure)


def overlay(
    time: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    label: str,
    after: np.ndarray | None = None,
    inside: np.ndarray | None = None,
    command: np.ndarray | None = None,
    band: str = "90 % band",
) -> str:
    """Measured against predicted motion with a band, the predictive 90 % one by default.

    Args:
      time: (T,) s.
      measured: (T,) as `predicted`, `low` and `high`.
      label: of the axis, with its unit.
      after: (T,) another model's prediction.
      inside: (T,) bool, shaded: where a phase of the motion holds.
      command: (T,) what was asked for.
      band: what it is.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(2.5)
        for begin, end in _stretches(inside) if inside is not None and not inside.all() else ():
            axes.axvspan(time[begin], time[min(end, len(time) - 1)], color=GREY, alpha=0.22, lw=0)
        axes.fill_between(time, low, high, color=BLUE, alpha=0.2, lw=0, label=band)
        if command is not None:
            _line(axes, time, command, color=INK, lw=0.8, ls=":", label="command")
        _line(axes, time, predicted, color=BLUE, label="predicted")
        if after is not None:
            _line(axes, time, after, color=GREEN, ls="-.", label="with the effect")
        _line(axes, time, measured, color=ORANGE, ls="--", label="measured")
        axes.set_xlabel("time / s")
        axes.set_ylabel(label)
        axes.margins(x=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=3, handlelength=1.8)
        return to_svg(figure)


def stacked(time: np.ndarray, rows: Sequence[tuple[str, Sequence[np.ndarray]]]) -> str:
    """Several signals of one kind over one time, below each other, each with its predictive 90 % band.

    Args:
      time: (T,) s.
      rows: label with unit, and measured, predicted, low, high, each (T,).
    """
    with matplotlib.rc_context(STYLE):
        figure = Canvas(figsize=(WIDE, 0.7 + 1.1 * len(rows)), layout="constrained")
        panels = figure.subplots(len(rows), sharex=True, squeeze=False)[:, 0]
        for axes, (label, (measured, predicted, low, high)) in zip(panels, rows, strict=True):
            axes.fill_between(time, low, high, color=BLUE, alpha=0.2, lw=0, label="90 % band")
            _line(axes, time, predicted, color=BLUE, label="predicted")
            _line(axes, time, measured, color=ORANGE, ls="--", label="measured")
            axes.set_ylabel(label)
            axes.margins(x=0)
        panels[-1].set_xlabel("time / s")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, handlelength=1.8)
        return to_svg(figure)


def _line(axes: Axes, time: np.ndarray, values: np.ndarray, **style: Any) -> None:
    """A line that breaks where values are missing, but for those between the samples of a slow recording."""
    known = np.isfinite(values)
    apart = not (known[1:] & known[:-1]).any()
    axes.plot(*((time[known], values[known]) if apart else (time, values)), **style)


def _stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and one past the last index of each run of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def bars(
    labels: Sequence[str], values: Sequence[float], errors: Sequence[float], chosen: Sequence[bool], axis: str
) -> str:
    """Horizontal bars with standard errors, those chosen in colour."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(0.6 + 0.3 * len(labels), WIDE)
        rows = np.arange(len(labels))
        axes.barh(rows, values, xerr=errors, color=[BLUE if c else GREY for c in chosen], height=0.62,
                  error_kw={"ecolor": INK, "elinewidth": 1.0, "capsize": 2})  # fmt: skip
        axes.axvline(0, color=INK, lw=0.6)
        axes.set_yticks(rows, labels)
        axes.invert_yaxis()
        axes.set_xlabel(axis)
        axes.tick_params(axis="y", length=0)
        return to_svg(figure)


def signal_bars(labels: Sequence[str], ratios: Sequence[float]) -> str:
    """Error over noise floor of every signal, the floor as a line."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(0.6 + 0.2 * len(labels), WIDE)
        rows = np.arange(len(labels))
        axes.barh(rows, ratios, color=BLUE, height=0.66)
        axes.axvline(1.0, color=ORANGE, lw=1.2, ls="--")
        axes.set_yticks(rows, labels, fontsize=8)
        axes.invert_yaxis()
        axes.margins(y=0.01)
        axes.set_xlabel("error / noise floor (dashed: the noise floor)")
        return to_svg(figure)


def interval(
    name: str, unit: str, value: float, low: float, high: float, null: float | None, bounds: tuple[float, float]
) -> str:
    """A fitted value with its 90 % interval on the parameter's range; a cross where the effect would vanish."""
    left, right = (end if np.isfinite(end) else seen for end, seen in zip(bounds, (low, high), strict=True))
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(1.15)
        axes.hlines(0, left, right, color=GREY, lw=4, alpha=0.35)
        axes.hlines(0, low, high, color=BLUE, lw=5)
        axes.plot([value], [0], "o", color=BLUE, ms=8)
        if null is not None:
            axes.plot([null], [0], "x", color=ORANGE, ms=9, mew=2)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(f"{name} / {unit}" if unit not in ("", "1") else name)
        axes.xaxis.set_major_locator(MaxNLocator(4))  # numbers like -0.00125 must not run into each other
        axes.set_ylim(-1, 1)
        return to_svg(figure)


def versions(name: str, unit: str, before: Interval, after: Interval, labels: tuple[str, str]) -> str:
    """A parameter's mean and 90 % interval in two versions, one above the other."""
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(1.35)
        for row, (interval, color) in enumerate(((before, GREY), (after, BLUE))):
            axes.hlines(row, interval.low90, interval.high90, color=color, lw=5)
            axes.plot([interval.mean], [row], "o", color=color, ms=8)
        axes.set_yticks([0, 1], labels)
        axes.set_ylim(1.6, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel(f"{name} / {unit}" if unit not in ("", "1") else name)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        return to_svg(figure)


def history(
    labels: Sequence[str], parents: Sequence[str], errors: Sequence[float], repeated: bool | None = None
) -> str:
    """The error of each model version, joined with its parent's, and the noise floor.

    Args:
      labels: of the versions.
      parents: label of each version's parent.
      errors: over the noise floor; NaN where nothing was measured, infinite where the prediction diverged.
      repeated: as for the ladder.
    """
    at = {label: i for i, label in enumerate(labels)}
    top = max(1.2 * max((e for e in errors if np.isfinite(e)), default=1.0), 1.3)
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(2.8, WIDE)
        axes.plot(np.arange(len(labels)), errors, "o", color=BLUE)
        for i, parent in enumerate(parents):
            if parent in at:
                axes.plot([at[parent], i], [errors[at[parent]], errors[i]], "-", color=BLUE)
        axes.axhline(1.0, color=ORANGE, ls="--", lw=1.2)
        axes.text(
            0,
            1.0,
            "noise floor" if repeated is not False else "noise floor, estimated",
            color=ORANGE,
            va="bottom",
            fontsize=9,
        )
        for x, error in enumerate(errors):
            if np.isfinite(error):
                axes.annotate(_times(error), (x, error), xytext=(0, 7), textcoords="offset points", ha="center")
            elif np.isinf(error):
                axes.annotate("diverged", (x, top), ha="center", va="top")
        axes.set_xticks(np.arange(len(labels)), labels)
        axes.set_ylim(0, top)
        axes.set_ylabel("error / noise floor")
        return to_svg(figure)
