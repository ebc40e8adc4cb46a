"""Compare: measured and predicted motion in 3D with one slider, signals beneath, errors over the noise floor."""

import json
from functools import cache
from pathlib import Path
from typing import Any

from nicegui import ui

from tcbi_dashboard import charts, task
from tcbi_dashboard.drawing import skeleton
from tcbi_dashboard.elements import Player, card, chart, empty, notes, say, soft, table, words
from tcbi_dashboard.names import SUMMARY
from tcbi_dashboard.picker import HOW_TO_RECORD, Picker
from tcbi_dashboard.session import Session
from tcbi_dashboard.views.base import View
from tcbi_sim.rigs import load_rig

NOTHING = "no second model"
FIRST_SIGNALS = 3


@cache
def skeleton_of(rig: str) -> dict[str, Any]:
    """A rig's drawing, made once."""
    return skeleton(load_rig(rig))


@cache
def _parsed(path: Path, stamp: int) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def summary_of(folder: Path | None) -> dict[str, Any] | None:
    """A comparison's summary, or None if there is none (any more)."""
    if folder is None:
        return None
    try:
        path = folder / SUMMARY
        if _parsed.cache_info().currsize > 4:
            _parsed.cache_clear()
        return _parsed(path, path.stat().st_mtime_ns)
    except OSError:
        return None


class CompareView(View):
    """The view; it shows the newest comparison of the store."""

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.player: Player | None = None
        self.found: dict[str, Any] | None = None

    def build(self) -> None:
        """The choice above, the result below."""
        with card("Replay recorded commands in a model"):
            self.picker = Picker(self.session, lambda: None)
            with ui.element("div").classes("tcbi-row"):
                self.also = ui.select([NOTHING], value=NOTHING, label="beside it").props("outlined dense options-dense")
                ui.button("Compare", on_click=self.compare, icon="compare_arrows").mark("compare")
        self.result = ui.element("div").classes("tcbi-grid")

    def state(self) -> object:
        """What the view depends on."""
        return self.bench.comparison(), self.bench.catalogue.revision == 0, bool(self.bench.catalogue.entries)

    def tick(self) -> None:
        """Twice a second while it is seen."""
        self.picker.refresh()
        others = [NOTHING, *self.session.versions()]
        if others != self.also.options:
            self.also.set_options(others, value=self.also.value if self.also.value in others else NOTHING)
        super().tick()
        if self.found:
            self._tell_choice(self.found)
        if self.session.place and self.player:
            place, self.session.place = self.session.place, None
            self.rollout.set_value(place.rollout)
            self.signals.set_value(list(dict.fromkeys([place.signal, *self.signals.value]))[:FIRST_SIGNALS])
            self.player.jump(place.time)
            self.player.reveal()

    def compare(self) -> None:
        """Start a comparison."""
        also = {} if self.also.value in (NOTHING, self.session.version()) else {"also": self.also.value}
        self.start(self.bench.task(task.COMPARE, self.session.version(), self.session.bags(), **also))

    def report(self) -> Path | None:
        """Of the newest comparison."""
        return self.bench.comparison_report()

    def refresh(self) -> None:
        """Show the newest comparison."""
        folder = self.bench.comparison()
        found = self.found = summary_of(folder)
        self.result.clear()
        self.player = None
        with self.result:
            if found is None and not self.bench.catalogue.entries:
                empty("There are no rollouts yet.", *HOW_TO_RECORD)
            elif found is None:
                empty("Nothing has been compared yet.", "Choose rollouts and a model version above, then Compare.")
            else:
                assert folder is not None
                self._headline(found)
                self._motion(found, folder.name)
                self._signals(found)

    def _headline(self, c: dict[str, Any]) -> None:
        with card(width="third"):
            words(charts.number(c["error_over_floor"], 2), "div", "tcbi-figure").mark("error")
            words(f"times the noise floor: {c['model']} on {len(c['rollouts'])} rollouts, joints and attitude")
            if any(rung["model"] == c["model"] and rung["fitted_here"] for rung in c.get("ladder", ())):
                soft(f"{c['model']} was fitted to some of these, so this is no test of it.")
            if c["also"]:
                words(f"{c['also']['model']}: {charts.number(c['also']['error_over_floor'], 2)} times")
            self.other = soft("")
            self._tell_choice(c)
        with card(width="two-thirds"):
            soft(c["floor_statement"])
            notes(c["guards"])
            if not c["guards"]:
                soft("Clock, rate, lag and order of joints of these recordings show nothing unusual.")

    def _tell_choice(self, c: dict[str, Any]) -> None:
        """Say it where the choice above is not what is shown."""
        same = {e.rollout_id for e in self.session.rollouts()} == set(c["rollouts"])
        changed = not same or self.session.version() != c["model"]
        say(self.other, "The choice above is another one; press Compare to see it." if changed else "")

    def _motion(self, c: dict[str, Any], folder: str) -> None:
        each = {i: f"{e['rollout']} · {e['policy']} · {charts.number(e['error_over_floor'], 2)} × floor"
                for i, e in enumerate(c["each"])}  # fmt: skip
        names = [ch["name"] for ch in c["channels"]]
        first = list(dict.fromkeys(m["signal"] for m in c["moments"]))[:FIRST_SIGNALS] or names[:FIRST_SIGNALS]
        worst = c["moments"][0]["rollout"] if c["moments"] else 0
        with card("Measured and predicted motion"):
            with ui.element("div").classes("tcbi-row"):
                self.rollout = ui.select(each, value=worst, label="rollout").props("outlined dense options-dense")
                self.signals = ui.select(names, value=first, label="signals", multiple=True)
                self.signals.props("outlined dense options-dense use-chips")
            self.player = Player(
                skeleton_of(c["rig"]),
                source=f"/data/{folder}/{worst}",
                model=c["model"],
                also=c["also"]["model"] if c["also"] else "",
                channels=c["channels"],
                signals=[names.index(s) for s in first],
                start=c["moments"][0].get("peak", c["moments"][0]["begin"]) if c["moments"] else 0.0,
            )
            player = self.player
            self.rollout.on_value_change(lambda e: player.show(source=f"/data/{folder}/{e.value}"))
            self.signals.on_value_change(lambda e: player.show(signals=[names.index(s) for s in e.value]))
            soft("The band holds 90 % of what the model says would be measured. Click a signal to go to that time.")

    def _signals(self, c: dict[str, Any]) -> None:
        ratios = {c["model"]: {s["name"]: s["ratio"] for s in c["signals"]}}
        if c["also"] and "ratios" in c["also"]:
            ratios[c["also"]["model"]] = c["also"]["ratios"]
        with card("Every signal"):
            chart(charts.over_floor(ratios), 120 + 17 * len(ratios) * len(c["signals"]))
            with ui.expansion("in figures").style("width: 100%"):
                columns = {"name": "signal", "unit": "unit", "error": "error", "noise_floor": "noise floor",
                           "ratio": "error / floor", "coverage90": "inside 90 % band"}  # fmt: skip
                rows = [{k: s[k] if k in ("name", "unit") else charts.number(s[k]) for k in columns}
                        for s in c["signals"]]  # fmt: skip
                table(columns, rows, "name", pagination=0)
