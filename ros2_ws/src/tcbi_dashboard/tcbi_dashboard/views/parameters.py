"""What is known of the parameters: two versions beside each other, and one version's distribution."""

import asyncio
from typing import Any

from nicegui import ui

from tcbi_dashboard import charts, versions
from tcbi_dashboard.elements import card, chart, notes, soft, table, words
from tcbi_sim.store import ModelStore

SHOWN_PAIRS = 6


def show_difference(store: ModelStore, known: list[str], after: str) -> None:
    """A card with two versions to choose, the oldest and `after` at first."""
    with card("What differs", "half"):
        if len(known) < 2:
            soft("There is one version only; add an effect, and the two can be compared here.")
            return
        with ui.element("div").classes("tcbi-row"):
            first = ui.select(known, value=known[0], label="before").props("outlined dense options-dense")
            second = ui.select(known, value=after, label="after").props("outlined dense options-dense")
        place = ui.element("div").style("width: 100%")

        async def show() -> None:
            d = await asyncio.to_thread(versions.difference, store, first.value, second.value)
            place.clear()
            with place:
                _difference(d, first.value, second.value)

        first.on_value_change(show)
        second.on_value_change(show)
        ui.timer(0.05, show, once=True)


def show_posterior(store: ModelStore, known: list[str], chosen: str) -> None:
    """A card with one version to choose, `chosen` at first."""
    with card("What is known of the parameters"):
        version = ui.select(known, value=chosen, label="version").props("outlined dense options-dense")
        version.style("max-width: 16rem")
        place = ui.element("div").classes("tcbi-grid")

        async def show() -> None:
            found = await asyncio.to_thread(versions.posterior, store, version.value)
            place.clear()
            with place:
                _posterior(found)

        version.on_value_change(show)
        ui.timer(0.1, show, once=True)


def _difference(d: dict[str, Any], before: str, after: str) -> None:
    words(d["statement"], "p")
    rows = [
        {
            "name": charts.with_unit(p["name"], p["unit"]),
            "before": span(p["before"]),
            "after": span(p["after"]),
            "overlap": _share(p["overlap"]),
            "width": _share(p["width_ratio"]),
        }
        for p in d["parameters"]
    ]
    heads = {"name": "parameter", "before": f"{before}: mean (90 %)", "after": after,
             "overlap": "overlap", "width": "width"}  # fmt: skip
    table(heads, rows, "name", pagination=0)
    soft(
        "Overlap: the share of the shorter 90 % interval that lies in the other one. Width: of the interval after, "
        "beside the one before. Both on the parameter's own scale."
    )


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


def span(values: list[float] | None) -> str:
    """A mean and its 90 % interval."""
    if values is None:
        return "–"
    return f"{charts.number(values[0])} ({charts.number(values[1])} to {charts.number(values[2])})"


def _posterior(found: dict[str, Any]) -> None:
    parameters = found["parameters"]
    with ui.element("div"):
        soft(found["origin"])
        rows = [
            {
                "name": charts.with_unit(p["name"], p["unit"]),
                "value": span([p["mean"], p["low90"], p["high90"]]),
                "tells": p["tells"],
            }
            for p in parameters
        ]
        heads = {"name": "parameter", "value": "mean (90 %)", "tells": "do the data tell more than was known before?"}
        table(heads, rows, "name", pagination=0)
        notes(found["notes"])
        if found["technical"]:
            with ui.expansion(f"{len(found['technical'])} notes more").style("width: 100%"):
                notes(found["technical"])
    pairs = [(a, b) for a in range(len(parameters)) for b in range(a)][:SHOWN_PAIRS]
    for a, b in pairs:
        points = [[round(row[b], 6), round(row[a], 6)] for row in found["draws"]]
        with ui.element("div").classes("tcbi-third"):
            chart(charts.pair(parameters[b], parameters[a], points), 250)
    if found["generations"]:
        _generations(found["generations"], parameters)


def _generations(steps: dict[str, Any], parameters: list[dict[str, Any]]) -> None:
    with ui.element("div"):
        words("Generation by generation", "strong")
        count = len(steps["number"])
        soft(f"How the inference came to it: mean and standard deviation after each of {count} generations.")
    for p in parameters:
        if p["name"] not in steps["mean"]:
            continue
        mean, sd = steps["mean"][p["name"]], steps["sd"][p["name"]]
        series = {
            "mean": list(zip(steps["number"], mean, strict=True)),
            "one standard deviation above": [(g, m + s) for g, m, s in zip(steps["number"], mean, sd, strict=True)],
            "below": [(g, m - s) for g, m, s in zip(steps["number"], mean, sd, strict=True)],
        }
        with ui.element("div").classes("tcbi-third"):
            chart(charts.lines("generation", charts.with_unit(p["name"], p["unit"]), series), 240)
