"""Where: the robot coloured by error, joint x phase, error against conditions, the worst moments."""

from pathlib import Path
from typing import Any

from nicegui import ui

from tcbi_dashboard import charts
from tcbi_dashboard.elements import RobotView, card, chart, empty, notes, soft, words
from tcbi_dashboard.session import Place
from tcbi_dashboard.views.base import View
from tcbi_dashboard.views.compare import skeleton_of, summary_of


class WhereView(View):
    """The view; it shows the newest comparison of the store."""

    def build(self) -> None:
        """Everything comes with a comparison."""
        self.result = ui.element("div").classes("tcbi-grid")

    def state(self) -> object:
        """What the view depends on."""
        return self.bench.comparison()

    def report(self) -> Path | None:
        """Of the newest comparison."""
        return self.bench.comparison_report()

    def refresh(self) -> None:
        """Show the newest comparison."""
        found = summary_of(self.bench.comparison())
        self.result.clear()
        with self.result:
            if found is None:
                empty(
                    "Nothing has been compared yet.", "Compare rollouts with a model first: where it fails shows here."
                )
                ui.button("Go to Compare", on_click=lambda: self.session.go_to("Compare")).style("justify-self: start")
                return
            with card():
                soft(f"{found['model']} on {len(found['rollouts'])} rollouts, as compared last on the Compare view.")
            self._robot(found)
            self._sentences(found)
            self._heat(found)
            self._moments(found)
            for curve in found["curves"]:
                with card(f"Error against {curve['condition'].partition(':')[0]}", "half"):
                    chart(charts.curve(curve["condition"], curve["unit"], curve["middle"], curve["error"]), 260)
            if found.get("steady"):
                soft(f"Not drawn, since it hardly varies in these rollouts: {', '.join(found['steady'])}.")

    def _robot(self, c: dict[str, Any]) -> None:
        with card("Error of each joint", "half"):
            RobotView(
                skeleton_of(c["rig"]), "The robot, each link in the colour of its joint's error", c["joint_errors"]
            )
            worst = sorted(c["joint_errors"].items(), key=lambda pair: -pair[1])[:3]
            soft(
                "Worst: " + ", ".join(f"{name} {charts.number(value, 2)} × noise floor" for name, value in worst) + "."
            )

    def _sentences(self, c: dict[str, Any]) -> None:
        with card("Where the error lives", "half"):
            if c["where"]:
                notes(f["statement"] for f in c["where"])
            else:
                soft("The error is spread evenly: no joint, phase or condition stands out.")

    def _heat(self, c: dict[str, Any]) -> None:
        heat = c["heat"]
        with card("Joint and phase of the motion"):
            made = chart(charts.heat(heat["joints"], heat["phases"], heat["values"]), 220 + 22 * len(heat["joints"]))
            made.on_point_click(lambda e: self._show_cell(heat, *e.value[:2]))
            soft(
                "Root mean square error in multiples of the noise floor. Click a cell to see where that joint's error "
                "is largest in that phase. Where a cell is blank, the joint is hardly ever in that phase."
            )

    def _moments(self, c: dict[str, Any]) -> None:
        with card("The worst moments"), ui.element("div").classes("tcbi-moments"):
            for moment in c["moments"]:
                words(moment["signal"], "strong")
                words(f"{charts.number(moment['over_floor'], 2)} × floor", "span")
                words(f"{charts.number(moment['error'], 2)} {moment['unit']}", "span")
                span = f"{moment['begin']:.2f} to {moment['end']:.2f} s"
                words(f"{c['each'][moment['rollout']]['policy']}, {span}", "span", "tcbi-soft")
                ui.button("Show", on_click=lambda m=moment: self._show(m)).props("flat dense")

    def _show_cell(self, heat: dict[str, Any], phase: int, joint: int) -> None:
        if "times" in heat:  # not in comparisons of older versions
            at = heat["rollouts"][phase][joint], heat["times"][phase][joint]
            self._go(Place(*at, heat["joints"][joint]))

    def _show(self, moment: dict[str, Any]) -> None:
        self._go(Place(moment["rollout"], moment.get("peak", moment["begin"]), moment["signal"]))

    def _go(self, place: Place) -> None:
        self.session.place = place
        self.session.go_to("Compare")
