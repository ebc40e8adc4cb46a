"""Why: which effect the model lacks, how sure that is, what it would change, and what to record next."""

import json
from pathlib import Path
from typing import Any

from nicegui import ui

from tcbi_dashboard import charts, next_motions, task
from tcbi_dashboard.elements import card, chart, empty, notes, say, soft, table, words
from tcbi_dashboard.live import Live
from tcbi_dashboard.picker import HOW_TO_RECORD, Picker
from tcbi_dashboard.session import Session
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.record import start_recording
from tcbi_infer.diagnose.adopt import objection
from tcbi_infer.diagnose.evidence import EFFECT, NextMotion, step_label


def _tone(diagnosis: dict[str, Any]) -> str:
    if diagnosis.get("reassuring"):
        return "good"
    return "warn" if diagnosis["verdict"] == EFFECT else ""


def read(path: Path | None) -> dict[str, Any] | None:
    """A diagnosis of the store, or None if there is none (any more)."""
    if path is None:
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


class WhyView(View):
    """The view; it shows the newest diagnosis of the store."""

    def __init__(self, session: Session, live: Live) -> None:
        super().__init__(session)
        self.live = live
        self.found: dict[str, Any] | None = None

    def build(self) -> None:
        """The choice above, the verdict below."""
        with card("Find the effect that the model lacks"):
            self.picker = Picker(self.session, lambda: None)
            with ui.element("div").classes("tcbi-row"):
                ui.button("Diagnose", on_click=lambda: self.diagnose(False), icon="search").mark("diagnose")
                quick = ui.button("Quick look", on_click=lambda: self.diagnose(True)).props("outline")
                quick.tooltip("a first answer: no single joints, fewer fits, no motion kept aside").mark("quick")
            soft("The best of the library's effects are fitted, and judged on motions that the fit has not seen.")
        self.result = ui.element("div").classes("tcbi-grid")

    def state(self) -> object:
        """What the view depends on."""
        return self.bench.diagnosis(), bool(self.bench.catalogue.entries)

    def tick(self) -> None:
        """Twice a second while it is seen."""
        self.picker.refresh()
        super().tick()
        if self.found:
            self._tell_choice(self.found)

    def diagnose(self, quick: bool) -> None:
        """Start a diagnosis."""
        self.start(self.bench.task(task.DIAGNOSE, self.session.version(), self.session.bags(), quick=quick))

    def report(self) -> Path | None:
        """Of the newest diagnosis."""
        path = self.bench.diagnosis()
        return path.with_suffix(".html") if path and path.with_suffix(".html").is_file() else None

    def refresh(self) -> None:
        """Show the newest diagnosis."""
        path = self.bench.diagnosis()
        found = self.found = read(path)
        self.result.clear()
        with self.result:
            if found is None and not self.bench.catalogue.entries:
                empty("There are no rollouts yet.", *HOW_TO_RECORD)
            elif found is None:
                empty(
                    "Nothing has been diagnosed yet.",
                    "Choose rollouts of several kinds of motion, six or more at best, each recorded twice; "
                    "then Diagnose. It takes minutes, and can be cancelled.",
                )
            else:
                assert path is not None
                self._verdict(found)
                self._next(found)
                self._ladder(found)
                self._ranking(found)
                self._sizes(found)
                self._moments(found, self.bench.moments(path))
                self._untestable(found)

    def _verdict(self, d: dict[str, Any]) -> None:
        with card(f"{d.get('headline', 'Diagnosis')} ({d['model']})"):
            words(d["statement"], "p", f"tcbi-verdict {_tone(d)}").mark("verdict")
            notes([*d.get("guards", ()), *d.get("claims", ())])
            if d.get("uses"):
                use = d["uses"][0]
                if told := objection(d, use):
                    words(f"{told}.", "p").mark("not-offered")
                elif not any(e["use"] == use and e["refined"] for e in d["ranking"]):
                    command = f"./tcbi add {use} --model {d['model']} --prior"
                    words(f"No fit can size it. As wide as its prior a terminal adds it: {command}", "p")
                else:
                    ui.button(f"Add {use} to {d['model']} …", on_click=lambda: self.session.go_to("Add")).style(
                        "align-self: start"
                    ).mark("go-add")
            self.other = soft("")
            self._tell_choice(d)

    def _tell_choice(self, d: dict[str, Any]) -> None:
        """Say it where the choice above is not what the verdict is about."""
        chosen, model = {e.rollout_id for e in self.session.rollouts()}, self.session.version()
        differs = [f"the model chosen above is {model}"] if model != d["model"] else []
        if chosen != set(d["rollouts"]):
            differs.append(f"of the {len(chosen)} rollouts chosen above {len(chosen & set(d['rollouts']))} were used")
        about = f"This verdict is about {d['model']} and {len(d['rollouts'])} rollouts"
        say(self.other, f"{about}; {' and '.join(differs)}." if differs else "")

    def _next(self, d: dict[str, Any]) -> None:
        motions = next_motions.motions(d)
        if not motions:
            return
        from tcbi_infer.diagnose import excitation  # takes a moment to load, and few diagnoses need it

        with card("What to record next"):
            for sentence in excitation.advice(motions):
                words(sentence, "p")
            for motion in {m.motion: m for m in excitation.best(motions)}.values():
                self._offer(motion)
            columns = {"motion": "motion", "what": "what it does", "between": "to tell apart",
                       "nats": "evidence / nats", "length": "length / s"}  # fmt: skip
            rows = [
                {
                    "key": i,
                    "motion": m.motion,
                    "what": m.description,
                    "between": " from ".join(use or "no new effect" for use in m.between),
                    "nats": charts.number(m.nats),
                    "length": charts.number(m.duration_s),
                }
                for i, m in enumerate(motions)
            ]
            with ui.expansion(f"{len(rows)} motions were considered").style("width: 100%"):
                table(columns, rows, "key", pagination=10)

    def _offer(self, motion: NextMotion) -> None:
        """A button that records a motion, where this page can; else what to do instead."""
        if not motion.command:
            words(f"{motion.motion}: command it twice, record both, and put the bags among these rollouts.", "p")
            ui.button(
                "Save its commands as CSV",
                on_click=lambda: ui.download.content(next_motions.as_csv(motion), f"{motion.motion}.csv"),
            ).props("outline").style("align-self: start")
            return
        if self.bench.access.motion:
            ui.button(
                f"Record {motion.motion} twice (the robot moves)", on_click=lambda: self._record(motion), icon="circle"
            ).style("align-self: start").mark("record-next")
        with ui.element("p"):
            words(motion.command, "code")

    def _record(self, motion: NextMotion) -> None:
        start_recording(self.bench, self.live, **next_motions.collection(motion))

    def _ladder(self, d: dict[str, Any]) -> None:
        with card("How wrong is the model?", "half"):
            errors = {step_label(k): v for k, v in d["errors"].items() if v is not None}
            chart(charts.ladder(errors), 90 + 44 * len(errors))
            soft(f"On motions that no fit has seen; model {d['model']}, {len(d['rollouts'])} rollouts.")

    def _ranking(self, d: dict[str, Any]) -> None:
        ranking = [e for e in d["ranking"] if e["elpd_gain"] is not None and e["elpd_se"] is not None]
        with card("Which effect explains the error?", "half"):
            chart(charts.gains(ranking, d["uses"]), 90 + 26 * min(12, len(ranking)))
            limit = charts.number(d.get("threshold"), 2)
            soft(
                "How much better unseen motions are predicted, with one standard error. "
                f"In square roots of the motions' gains, luck alone reaches {limit} standard errors."
            )
        with card("The candidates in figures"):
            columns = {"use": "effect", "gain": "held-out gain / nats", "se": "s.e.", "before": "error before",
                       "after": "after", "size": "size (90 % interval)", "why": "accepted?",
                       "alike": "looks like"}  # fmt: skip
            rows = [
                {
                    "use": e["use"],
                    "gain": charts.number(e["elpd_gain"]),
                    "se": charts.number(e["elpd_se"]),
                    "before": charts.number(e["error_before"]),
                    "after": charts.number(e["error_after"]) if e["refined"] else "–",
                    "size": "; ".join(_size(p) for p in e["parameters"]) or "screened only",
                    "why": "yes" if e["accepted"] else e["reason"],
                    "alike": ", ".join(e["confused_with"]),
                }
                for e in d["ranking"]
            ]
            with ui.expansion(f"{len(rows)} candidates").style("width: 100%"):
                table(columns, rows, "use", pagination=10)

    def _sizes(self, d: dict[str, Any]) -> None:
        named = [e for e in d["ranking"] if e["use"] in d["uses"]]
        estimates = [p for e in named for p in e["parameters"]]
        if not estimates:
            return
        with card("How large is it?"):
            with ui.element("div").classes("tcbi-grid"):
                for estimate in estimates:
                    with ui.element("div").classes("tcbi-half"):
                        words(_size(estimate), "p")
                        chart(charts.interval(estimate), 130)
            crosses = any(e["null"] is not None for e in estimates)
            soft(f"Dot: fitted value; bar: 90 % interval{'; cross: where the effect would vanish' * crosses}.")

    def _moments(self, d: dict[str, Any], moments: list[dict[str, Any]]) -> None:
        if not moments or not isinstance(moments[0]["after"], dict):
            with card("What an effect would change"):
                soft("No candidate was fitted, or this diagnosis has kept no motions to show one on.")
            return
        uses = [e["use"] for e in d["ranking"] if e["use"] in moments[0]["after"]]
        with card("What an effect would change"), ui.element("div").classes("tcbi-row"):
            soft("The worst moments of the model, with and without")
            chosen = ui.select(uses, value=uses[0], label="effect").props("outlined dense options-dense")
        place = ui.element("div").classes("tcbi-grid")

        def draw() -> None:
            place.clear()
            with place:
                for moment in moments[:4]:
                    with card(f"{moment['signal']} before and after", "half"):
                        chart(charts.moment(moment, chosen.value), 280)
                        fitted = "this motion" if d["nothing_held_out"] else "other kinds of motion than this"
                        soft(f"Rollout {moment['rollout']}; both were fitted to {fitted}.")

        chosen.on_value_change(draw)
        draw()

    def _untestable(self, d: dict[str, Any]) -> None:
        shown = [s for s in d.get("detectable", ()) if s["value"] is not None]
        if shown:
            with card("The smallest effects that these rollouts could have shown"):
                rows = [
                    {"use": s["use"], "value": f"{s['parameter'].rpartition('.')[2]} {charts.number(s['value'])} "
                                               f"{s['unit'].removeprefix('1')}".strip()}
                    for s in shown
                ]  # fmt: skip
                with ui.expansion(f"{len(rows)} sizes").style("width: 100%"):
                    table({"use": "effect", "value": "smallest size"}, rows, "use", pagination=10)
        if d.get("untestable"):
            with card("What these rollouts cannot test"):
                soft(
                    "In these rollouts the following change nothing that can be measured: " + ", ".join(d["untestable"])
                )


def _size(p: dict[str, Any]) -> str:
    name, unit = p["name"].rpartition(".")[2], p["unit"].removeprefix("1")
    low, high = charts.number(p["low90"]), charts.number(p["high90"])
    return f"{name} {charts.number(p['value'])} ({low} to {high}) {unit}".strip()
