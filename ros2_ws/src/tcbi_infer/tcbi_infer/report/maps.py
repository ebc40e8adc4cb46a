"""Figures of where the error lives: joint x phase, and error against load, speed, slope and more."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle

from tcbi_infer.compare.maps import Curve, Heat
from tcbi_infer.report.drawing import Scale
from tcbi_infer.report.plots import BLUE, ORANGE, STYLE, WIDE, canvas, to_svg

DARK = 0.55  # of the colour scale, from which text on it is white
COLUMNS = 3


def heat_map(heat: Heat, scale: Scale) -> str:
    """One row for each joint, one column for each phase, the figure in each cell."""
    values = heat.values.T
    with matplotlib.rc_context(STYLE):
        figure, axes = canvas(0.9 + 0.23 * len(heat.joints), 0.95 * len(heat.phases) + 1.2)
        for j, p in np.ndindex(values.shape):
            value = float(values[j, p])
            axes.add_patch(Rectangle((p, j), 1, 1, facecolor=scale.color(value), edgecolor="white"))
            text = "–" if np.isnan(value) else f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
            ink = "white" if np.isfinite(value) and scale.share(value) > DARK else "black"
            axes.text(p + 0.5, j + 0.5, text, ha="center", va="center", fontsize=8, color=ink)
        axes.set_xlim(0, values.shape[1])
        axes.set_ylim(0, values.shape[0])
        axes.set_yticks(np.arange(len(heat.joints)) + 0.5, heat.joints, fontsize=8)
        axes.set_xticks(np.arange(len(heat.phases)) + 0.5, [_wrapped(p) for p in heat.phases], fontsize=8)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.invert_yaxis()
        for side in axes.spines.values():
            side.set_visible(False)
        return to_svg(figure)


def _wrapped(phase: str) -> str:
    """Two lines of a phase's name."""
    words = phase.split()
    half = (len(words) + 1) // 2
    return " ".join(words[:half]) + "\n" + " ".join(words[half:])


def curves(found: Sequence[Curve]) -> str:
    """Error over noise floor against each condition, side by side."""
    rows = -(-len(found) // COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Canvas(figsize=(WIDE + 2.0, 0.3 + 1.9 * rows), layout="constrained")
        panels = figure.subplots(rows, COLUMNS, squeeze=False, sharey=True).ravel()
        for axes, curve in zip(panels, found, strict=False):
            axes.plot(curve.middle, curve.error, "o-", color=BLUE, ms=4)
            axes.axhline(1.0, color=ORANGE, ls="--", lw=1.0)
            axes.set_xlabel(f"{curve.condition}{f' / {curve.unit}' * bool(curve.unit)}", fontsize=8)
            axes.tick_params(labelsize=8)
        panels[0].set_ylim(bottom=0)  # of all of them: none is scaled any more
        for axes in panels[len(found) :]:
            axes.set_visible(False)
        for axes in panels[::COLUMNS]:
            axes.set_ylabel("error / noise floor", fontsize=8)
        return to_svg(figure)
