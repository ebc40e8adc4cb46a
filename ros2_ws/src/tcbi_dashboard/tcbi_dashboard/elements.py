"""Parts that several views share: charts, cards, empty states, the two elements that draw in 3D."""

import html
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import nicegui.elements.echart
import nicegui.elements.scene  # these two register the libraries that the elements below import in the browser
from nicegui import ui
from nicegui.element import Element

BROWSER = Path(__file__).parent / "browser"


class Player(Element, component="browser/player.js", esm={"tcbi-stage": "browser/stage"}):
    """A rollout and its prediction in 3D with one time slider, and signals beneath; see pack.py for its source."""

    def __init__(self, skeleton: dict[str, Any], **props: Any) -> None:
        super().__init__()
        self.show(skeleton=skeleton, **props)

    def show(self, **props: Any) -> None:
        """Set some of: source, model, also, channels, signals, start."""
        self._props.update(props)
        self.update()

    def jump(self, time_s: float) -> None:
        """Go to a time, also if it was gone to before."""
        self.show(start=time_s)
        self.run_method("jump", time_s)


class RobotView(Element, component="browser/robot_view.js"):
    """One robot, coloured by the errors of its joints or posed live."""

    def __init__(self, skeleton: dict[str, Any], label: str, errors: dict[str, float] | None = None) -> None:
        super().__init__()
        self._props.update(skeleton=skeleton, label=label, errors=errors or {})

    def pose(self, base: list[float], joints: list[float]) -> None:
        """Put it into a posture: base (7,) position m and quaternion w x y z, joints in rad."""
        self.run_method("pose", base, joints)


def card(title: str = "", width: str = "") -> ui.element:
    """A card with a heading, to be filled in a `with`; `width` is half, third or two-thirds on a wide screen."""
    element = ui.element("section").classes(f"tcbi-card {f'tcbi-{width}' if width else ''}")
    if title:
        with element:
            words(title, "h2")
    return element


def words(said: str, tag: str = "p", classes: str = "") -> ui.html:
    """Plain text in an element of its own."""
    return ui.html(html.escape(said), tag=tag, sanitize=False).classes(classes)


def soft(said: str) -> ui.html:
    """A paragraph of explanation."""
    return words(said, "p", "tcbi-soft")


def notes(sentences: Iterable[str]) -> None:
    """A list of sentences."""
    listed = list(sentences)
    if listed:
        with ui.element("ul").classes("tcbi-notes"):
            for sentence in listed:
                words(sentence, "li")


def empty(what: str, *steps: str) -> None:
    """What is not there yet, and what to do first; a step in backquotes is a command."""
    with ui.element("div").classes("tcbi-empty"):
        words(what, "strong")
        for step in steps:
            if step.startswith("`"):
                with ui.element("p"):
                    words(step.strip("`"), "code")
            else:
                soft(step)


def chart(options: dict[str, Any], height: int) -> ui.echart:
    """A chart of a height in pixels, as wide as its place."""
    return ui.echart(options).classes("tcbi-chart").style(f"height: {height}px")


def table(columns: dict[str, str], rows: list[dict[str, Any]], key: str, **more: Any) -> ui.table:
    """A plain table: column names and their headings."""
    numeric = {c for c in columns if any(isinstance(r.get(c), (int, float)) for r in rows)}
    listed = [
        {"name": c, "label": label, "field": c, "align": "right" if c in numeric else "left", "sortable": True}
        for c, label in columns.items()
    ]
    made = ui.table(columns=listed, rows=rows, row_key=key, **more).props("flat dense wrap-cells").style("width: 100%")
    return made if len(rows) > (more.get("pagination") or len(rows)) else made.props("hide-bottom")


__all__ = ["Player", "RobotView", "card", "chart", "empty", "nicegui", "notes", "soft", "table", "words"]
