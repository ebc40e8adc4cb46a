"""Charts as ECharts options: colours that colour-blind readers tell apart, units on every axis, for light and dark."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#8c949e"  # Okabe and Ito
INK = "#7b838c"  # stands out from both the light and the dark page
SCALE = ["#00224e", "#2a3f6d", "#575d6d", "#7d7c78", "#a69d75", "#d3c064", "#fee838"]  # cividis
MOST_LABELS = 8  # that a phone has room for
Options = dict[str, Any]


def _axis(name: str = "", **more: Any) -> Options:
    return {
        "name": name,
        "nameLocation": "middle",
        "nameGap": 28,
        "nameTextStyle": {"color": INK, "fontSize": 13},
        "axisLabel": {"color": INK, "hideOverlap": True, "fontSize": 13},
        "axisLine": {"lineStyle": {"color": INK}},
        "splitLine": {"lineStyle": {"color": INK, "opacity": 0.15}},
        **more,
    }


def _frame(**more: Any) -> Options:
    return {
        "animation": False,
        "textStyle": {"fontFamily": "system-ui, sans-serif"},
        "grid": {"left": 62, "right": 24, "top": 34, "bottom": 52},
        "tooltip": {"confine": True},
        **more,
    }


def _beside(names: Sequence[str], **more: int) -> Options:
    """A grid with room for names at its left."""
    return {
        "left": 16 + round(7.2 * max((len(n) for n in names), default=4)),
        "right": 24,
        "top": 28,
        "bottom": 52,
        **more,
    }


def number(value: float | None, digits: int = 3) -> str:
    """A number for people, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}g}"


def with_unit(name: str, unit: str) -> str:
    """An axis title."""
    return f"{name} / {unit}" if unit not in ("", "1") else name


def over_floor(errors: Mapping[str, Mapping[str, float | None]]) -> Options:
    """Error over the noise floor of every signal, of one model or two; the floor as a line."""
    names = list(next(iter(errors.values())))
    bars = [
        {
            "name": model,
            "type": "bar",
            "data": [_rounded(own.get(n)) for n in names],
            "itemStyle": {"color": color},
            "barMaxWidth": 14,
        }
        for (model, own), color in zip(errors.items(), (BLUE, GREEN), strict=False)
    ]
    bars[0]["markLine"] = _line_at_one("xAxis")
    legend = {"legend": {"textStyle": {"color": INK}, "left": 0, "top": 0}} if len(bars) > 1 else {}
    return _frame(
        grid=_beside(names),
        xAxis=_axis("error / noise floor", type="value", min=0),
        yAxis=_axis(type="category", data=names, inverse=True),
        series=bars,
        **legend,
    )


def _line_at_one(axis: str) -> Options:
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": {"color": ORANGE, "type": "dashed", "width": 1.5},
        "label": {
            "formatter": "noise floor",
            "color": ORANGE,
            "position": "start" if axis == "xAxis" else "insideEndTop",
        },
        "data": [{axis: 1}],
    }


def heat(joints: Sequence[str], phases: Sequence[str], values: Sequence[Sequence[float | None]]) -> Options:
    """Joint x phase, coloured by error over the noise floor; the value of a point is [phase, joint, error]."""
    cells = [
        {"name": f"{joints[j]} {phases[p]}", "value": [p, j, _rounded(v)]}
        for p, row in enumerate(values)
        for j, v in enumerate(row)
        if v is not None
    ]
    top = max((v for row in values for v in row if v is not None), default=2.0)
    said = "(p) => `${p.name}: ${p.marker}${Number(p.value[2]).toPrecision(2)} × noise floor`"
    return _frame(
        grid=_beside(joints, right=16, bottom=160),
        xAxis=_axis(type="category", data=list(phases), axisLabel={"color": INK, "rotate": 35, "interval": 0}),
        yAxis=_axis(type="category", data=list(joints), inverse=True, axisLabel={"color": INK, "interval": 0}),
        tooltip={"confine": True, ":formatter": said},
        visualMap={
            "min": 1,
            "max": max(1.5, top),
            "calculable": False,
            "orient": "horizontal",
            "left": "center",
            "bottom": 0,
            "text": [f"{top:.2g} × noise floor", "1"],
            "textStyle": {"color": INK},
            "inRange": {"color": SCALE},
        },
        series=[{"type": "heatmap", "data": cells, "itemStyle": {"borderWidth": 1, "borderColor": "transparent"}}],
    )


def curve(condition: str, unit: str, middle: Sequence[float | None], error: Sequence[float | None]) -> Options:
    """Error against one condition."""
    points = [[_rounded(x), _rounded(y)] for x, y in zip(middle, error, strict=True)]
    return _frame(
        xAxis=_axis(with_unit(condition, unit), type="value", scale=True),
        yAxis=_axis("error / noise floor", type="value", min=0, nameGap=34),
        series=[
            {
                "type": "line",
                "symbol": "circle",
                "data": points,
                "lineStyle": {"color": BLUE},
                "itemStyle": {"color": BLUE},
                "markLine": _line_at_one("yAxis"),
            }
        ],
    )


def gains(ranking: Sequence[Mapping[str, Any]], chosen: Sequence[str], most: int = 12) -> Options:
    """Held-out gain of each candidate with its standard error; in colour what the verdict names."""
    shown = list(ranking[:most])
    bars = [
        {"value": _rounded(e["elpd_gain"]), "itemStyle": {"color": BLUE if e["use"] in chosen else GREY}} for e in shown
    ]
    whiskers = []
    for row, e in enumerate(shown):
        low, high = e["elpd_gain"] - e["elpd_se"], e["elpd_gain"] + e["elpd_se"]
        whiskers.append([[low, row], [high, row]])
    return _frame(
        grid=_beside([e["use"] for e in shown]),
        xAxis=_axis("held-out gain / nats", type="value", splitNumber=4),
        yAxis=_axis(type="category", data=[e["use"] for e in shown], inverse=True, axisLine={"show": False}),
        series=[
            {"type": "bar", "data": bars, "barMaxWidth": 16},
            *(
                {
                    "type": "line",
                    "data": [[_rounded(x), y] for x, y in ends],
                    "lineStyle": {"color": INK, "width": 1.5},
                    "symbol": "rect",
                    "symbolSize": [2, 9],
                    "itemStyle": {"color": INK},
                    "silent": True,
                    "tooltip": {"show": False},
                }
                for ends in whiskers
            ),
        ],
    )


def interval(estimate: Mapping[str, Any]) -> Options:
    """A fitted value with its 90 % interval; a cross where the effect would vanish."""
    null = estimate.get("null")
    ends = [estimate["low90"], estimate["high90"], estimate["value"], *([null] if null is not None else [])]
    pad = 0.12 * (max(ends) - min(ends) or abs(estimate["value"]) or 1.0)
    series: list[Options] = [
        {
            "type": "line",
            "data": [[_rounded(estimate["low90"]), 0], [_rounded(estimate["high90"]), 0]],
            "lineStyle": {"color": BLUE, "width": 6},
            "showSymbol": False,
        },
        {"type": "scatter", "data": [[_rounded(estimate["value"]), 0]], "symbolSize": 14, "itemStyle": {"color": BLUE}},
    ]
    if null is not None:
        cross = "path://M0,0L10,10M10,0L0,10"
        mark = {"color": "transparent", "borderColor": ORANGE, "borderWidth": 2.5}
        series.append({"type": "scatter", "symbol": cross, "symbolSize": 12, "data": [[null, 0]], "itemStyle": mark})
    return _frame(
        xAxis=_axis(
            with_unit(estimate["name"], estimate["unit"]), type="value", min=min(ends) - pad, max=max(ends) + pad,
            axisLabel={"color": INK, "hideOverlap": True, "showMinLabel": False, "showMaxLabel": False},
        ),
        yAxis={"type": "value", "min": -1, "max": 1, "show": False},
        series=series,
    )  # fmt: skip


def moment(data: Mapping[str, Any], after: str) -> Options:
    """A piece of one signal: measured, and predicted before and after a candidate."""

    def line(name: str, values: Sequence[float | None], color: str, kind: Any) -> Options:
        return {
            "name": name,
            "type": "line",
            "symbol": "none",
            "data": [[_rounded(t), _rounded(v)] for t, v in zip(data["time"], values, strict=True)],
            "lineStyle": {"color": color, "type": kind, "width": 1.8},
            "itemStyle": {"color": color},
        }

    series = [line("without it", data["before"], BLUE, [5, 3])]
    if after in data["after"]:
        series.append(line(f"with {after}", data["after"][after], GREEN, [8, 3, 2, 3]))
    series.append(line("measured", data["measured"], ORANGE, "solid"))
    return _frame(
        legend={"textStyle": {"color": INK}, "left": 0, "top": 0, "itemWidth": 30, "itemStyle": {"opacity": 0}},
        tooltip={"trigger": "axis", "confine": True},
        xAxis=_axis("time / s", type="value", min="dataMin", max="dataMax", splitLine={"show": False}),
        yAxis=_axis(with_unit(data["signal"], data["unit"]), type="value", scale=True, nameGap=40),
        series=series,
    )


def history(errors: Mapping[str, float | None], parents: Mapping[str, str | None]) -> Options:
    """The error of each version, joined with that of the version it was made from; a dash for one without a figure."""
    names = list(errors)
    at = {name: i for i, name in enumerate(names)}
    labels = []
    for i, name in enumerate(names):
        parent = parents.get(name)
        from_where = f"\nfrom {_short(parent)}" if parent and at.get(parent) != i - 1 else ""
        labels.append(f"{_short(name)}{from_where}" + ("" if errors[name] is not None else "\n–"))
    edges = [
        [[at[parent], _rounded(errors[parent])], [at[name], _rounded(error)]]
        for name, error in errors.items()
        if error is not None and (parent := parents.get(name)) and errors.get(parent) is not None
    ]
    few = len(names) <= MOST_LABELS
    return _frame(
        grid={"left": 62, "right": 24, "top": 34, "bottom": 64},
        tooltip={"confine": True, ":formatter": "(p) => `${p.name}: ${Number(p.value[1]).toPrecision(3)} × floor`"},
        xAxis=_axis(
            type="category",
            data=labels,
            axisLabel={
                "color": INK,
                "fontSize": 13,
                "lineHeight": 17,
                "hideOverlap": not few,
                "interval": 0 if few else "auto",
            },
        ),
        yAxis=_axis("error / noise floor", type="value", min=0, nameGap=36),
        series=[
            *(
                {
                    "type": "line",
                    "data": ends,
                    "symbol": "none",
                    "lineStyle": {"color": BLUE, "width": 2.5},
                    "silent": True,
                    "tooltip": {"show": False},
                }
                for ends in edges
            ),
            {
                "type": "scatter",
                "data": [
                    {"name": n, "value": [i, _rounded(errors[n])]} for n, i in at.items() if errors[n] is not None
                ],
                "symbolSize": 10,
                "itemStyle": {"color": BLUE},
                "label": {
                    "show": True,
                    "position": "top",
                    "color": INK,
                    "fontSize": 14,
                    ":formatter": "(p) => Number(p.value[1]).toPrecision(2)",
                },
                "markLine": _line_at_one("yAxis"),
            },
        ],
    )


def _short(version: str) -> str:
    """The number of a version, which tells it from the others of its rig."""
    return f"v{version.rpartition('-v')[2]}"


def ladder(errors: Mapping[str, float]) -> Options:
    """Error over the noise floor of the robot against itself and of each model."""
    values = {"the robot against itself": 1.0, **errors}
    colors = [GREY, *[BLUE] * len(errors)]
    bars = [{"value": _rounded(v), "itemStyle": {"color": c}} for v, c in zip(values.values(), colors, strict=True)]
    return _frame(
        grid=_beside(list(values), right=48),
        xAxis=_axis("error / noise floor", type="value", min=0, splitNumber=4),
        yAxis=_axis(type="category", data=list(values), inverse=True, axisLine={"show": False}),
        series=[
            {
                "type": "bar",
                "data": bars,
                "barMaxWidth": 22,
                "label": {
                    "show": True,
                    "position": "right",
                    "color": INK,
                    ":formatter": "(p) => p.value.toPrecision(2)",
                },
            }
        ],
    )


def pair(x: Mapping[str, Any], y: Mapping[str, Any], points: Sequence[Sequence[float]]) -> Options:
    """Two parameters' draws against each other; the axes span their priors, each on its prior's scale."""
    dots = {"type": "scatter", "data": [list(p) for p in points], "symbolSize": 5}
    return _frame(
        xAxis=_over(x),
        yAxis=_over(y, nameGap=46),
        series=[{**dots, "itemStyle": {"color": BLUE, "opacity": 0.45}}],
    )


def _over(p: Mapping[str, Any], **more: Any) -> Options:
    """An axis over a parameter's prior."""
    kind = "log" if p["scale"] == "log" else "value"
    digits = {
        "color": INK,
        "hideOverlap": True,
        "fontSize": 13,
        ":formatter": "(v) => String(Number(v.toPrecision(2)))",
    }
    return _axis(with_unit(p["name"], p["unit"]), type=kind, min=p["low"], max=p["high"], axisLabel=digits, **more)


def lines(x_title: str, y_title: str, series: Mapping[str, Sequence[Sequence[float | None]]]) -> Options:
    """Named lines over a common axis."""
    palette = [BLUE, ORANGE, GREEN, "#cc79a7", "#56b4e9", "#e69f00", GREY]
    return _frame(
        legend={"textStyle": {"color": INK}, "left": 0, "top": 0, "type": "scroll", "right": 30},
        tooltip={"trigger": "axis", "confine": True},
        xAxis=_axis(x_title, type="value", min="dataMin", max="dataMax", minInterval=1, splitLine={"show": False}),
        yAxis=_axis(y_title, type="value", scale=True, nameGap=42),
        series=[
            {
                "name": label,
                "type": "line",
                "symbol": "circle" if len(points) < 30 else "none",
                "data": [[_rounded(a), _rounded(b)] for a, b in points],
                "lineStyle": {"color": palette[i % len(palette)]},
                "itemStyle": {"color": palette[i % len(palette)]},
            }
            for i, (label, points) in enumerate(series.items())
        ],
    )


def _rounded(value: float | None) -> float | None:
    """Five digits are more than a screen shows; None where there is no number."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")


def levels(names: Sequence[str], title: str, limit: float) -> Options:
    """One bar for each of some values that change all the time, between two limits."""
    return _frame(
        grid=_beside(names),
        xAxis=_axis(title, type="value", min=-limit, max=limit),
        yAxis=_axis(type="category", data=list(names), inverse=True),
        series=[{"type": "bar", "data": [0.0] * len(names), "itemStyle": {"color": BLUE}, "barMaxWidth": 12}],
    )
