"""The body's signals, measured and predicted: attitude, rates, contacts and distance, where each errs most."""

import numpy as np

from tcbi_infer.compare.comparison import Comparison
from tcbi_infer.compare.signals import ATTITUDE, CONTACT, RATE
from tcbi_infer.report import plots
from tcbi_infer.report.page import Figure

SHOWN_S = 10.0  # s around the worst moment that are drawn
ABOUT_S = 1.5  # s, length of the moment that is looked for
TITLES = {ATTITUDE: "Attitude", RATE: "Body rates", CONTACT: "Foot contacts"}


def body_figures(c: Comparison) -> list[Figure]:
    """One figure for each group that was measured."""
    figures = []
    for group, title in TITLES.items():
        index = c.replay.layout.where(group)
        error = ((c.replay.measured - c.predicted)[..., index] / c.floor.values[index]) ** 2
        place = _worst(c, error.mean(axis=-1)) if len(index) else None
        if place is None:
            continue
        r, cut = place
        arrays = (c.replay.shown, c.predicted, c.low, c.high)
        names = [c.replay.layout.channels[i].name for i in index]
        labels = [f"{name.removeprefix('contact_')} / {group.unit}" for name in names]
        rows = [(label, [a[r, cut, i] for a in arrays]) for label, i in zip(labels, index, strict=True)]
        figures.append(_figure(c, title, r, cut, rows))
    d = c.distance
    place = None if d is None else _worst(c, (d.measured - d.predicted) ** 2)
    if d is not None and place is not None:
        r, cut = place
        traces = [a[r, cut] for a in (d.measured, d.predicted, d.low, d.high)]
        figures.append(_figure(c, "Distance", r, cut, [("distance / m", traces)]))
    return figures


def _figure(c: Comparison, title: str, r: int, cut: slice, rows: list[tuple[str, list[np.ndarray]]]) -> Figure:
    svg = plots.stacked(c.replay.time[cut], rows)
    return Figure(svg, f"{title} in {c.rollouts[r]}.", wide=True)


def _worst(c: Comparison, error: np.ndarray) -> tuple[int, slice] | None:
    """Rollout and samples to draw, around the stretch with the most squared error (R, T); None if nothing is told."""
    if not np.isfinite(error).any():
        return None
    length, rate = error.shape[1], c.replay.layout.rate
    about, shown = (min(length, round(s * rate)) for s in (ABOUT_S, SHOWN_S))
    total = np.cumsum(np.concatenate([np.zeros((len(error), 1)), np.nan_to_num(error)], axis=1), axis=1)
    windows = total[:, about:] - total[:, :-about]
    r, t = (int(i) for i in np.unravel_index(int(np.argmax(windows)), windows.shape))
    first = int(np.clip(t + about // 2 - shown // 2, 0, length - shown))
    there = np.nonzero(np.isfinite(error[r]))[0]  # a rollout may end before the longest one does
    return r, slice(max(first, int(there[0])), min(first + shown, int(there[-1]) + 1))
