"""Parts that several views share: charts, cards, empty states, the two elements that draw in 3D."""

import contextlib
import html
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import nicegui.elements.echart
import nicegui.elements.scene  # these two register the libraries that the elements below import in the browser
from nicegui import ui
from nicegui.element import Element

from tcbi_dashboard.entry import Allowed

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

    def reveal(self) -> None:
        """Scroll to where its drawing begins."""
        self.run_method("reveal")


class RobotView(Element, component="browser/robot_view.js"):
    """One robot, coloured by the errors of its joints or posed live."""

    def __init__(self, skeleton: dict[str, Any], label: str, errors: dict[str, float] | None = None) -> None:
        super().__init__()
        self._props.update(skeleton=skeleton, label=label, errors=errors or {})

    def pose(self, base: list[float], joints: list[float]) -> None:
        """Put it into a posture: base (7,) position m and quaternion w x y z, joints in rad."""
        self.run_method("pose", base, joints)


class NumberField(ui.input):
    """A field for a number; while its entry is wrong it is marked, and says what is allowed."""

    def __init__(self, label: str, allowed: Allowed, value: float | None) -> None:
        self.allowed = allowed
        typed = "" if value is None else f"{value:.10g}"
        super().__init__(label, value=typed, placeholder=allowed.unset or None, validation=self._fault)
        keys = "decimal" if allowed.low >= 0 else "text"  # what a phone offers; its digits have no minus
        self.props(f"outlined dense stack-label hide-bottom-space no-error-icon inputmode={keys}")

    def _fault(self, typed: str | None) -> str | None:
        return self.allowed.fault(typed or "")

    @property
    def number(self) -> float | None:
        """The number; None where the field is empty and may be. Ask only what `all_right` has passed."""
        return self.allowed.read(self.value or "")


def number_field(
    label: str, low: float, high: float, value: float | None = None, *, whole: bool = False, unset: str = ""
) -> NumberField:
    """A field for a number from `low` to `high`, with a `value` at first; `unset` is what an empty one stands for.

    Nothing wrong is put right in silence: check `all_right(field, …)` before `field.number` is used.
    """
    return NumberField(label, Allowed(low, high, whole, unset), value)


def all_right(*fields: NumberField) -> bool:
    """Whether every entry is allowed; says so to the user where one is not."""
    wrong = [str(field.props["label"]) for field in fields if not field.validate()]
    if wrong:
        ui.notify(f"Nothing was started: correct {'; '.join(wrong)}.", type="warning")
    return not wrong


def card(title: str = "", width: str = "") -> ui.element:
    """A card with a heading, to be filled in a `with`; `width` is half, third or two-thirds on a wide screen."""
    element = ui.element("section").classes(f"tcbi-card {f'tcbi-{width}' if width else ''}")
    if title:
        with element:
            words(title, "h2")
    return element


@contextlib.contextmanager
def window(style: str) -> Iterator[ui.dialog]:
    """A dialog, to be filled in a `with`, that is open then; it outlives what is drawn anew beneath it."""
    with ui.context.client.content, ui.dialog() as dialog, ui.element("div").classes("tcbi-card").style(style):
        yield dialog
    dialog.on("hide", dialog.delete)
    dialog.open()


def words(said: str, tag: str = "p", classes: str = "") -> ui.html:
    """Plain text in an element of its own."""
    return ui.html(html.escape(said), tag=tag, sanitize=False).classes(classes)


def say(place: ui.html, said: str, old: bool = False) -> None:
    """New text for `words`; what is old looks so."""
    place.set_content(html.escape(said))
    place.classes(**{"add" if old else "remove": "tcbi-old"})


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


__all__ = [
    "NumberField",
    "Player",
    "RobotView",
    "all_right",
    "card",
    "chart",
    "empty",
    "nicegui",
    "notes",
    "number_field",
    "say",
    "soft",
    "table",
    "window",
    "words",
]
