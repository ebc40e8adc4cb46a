"""A report: a title, a lead, sections of text, figures and tables; written as one self-contained HTML file.

report = Report("What the model gets wrong", lead="Nine motions, each recorded twice.")
add_comparison(report, comparison)
report.add(Section("Policy", text=["…"], table=Table(["model", "return"], rows)))
report.write(path)
"""

import dataclasses
import datetime
import hashlib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from tcbi_contract.files import replace_file
from tcbi_infer.errors import InferError


@dataclasses.dataclass(frozen=True)
class Figure:
    """An inline SVG with its caption.

    Attributes:
      wide: it takes the full width of the page.
      name: of a file of its own, without suffix; "" for none.
    """

    svg: str
    caption: str
    wide: bool = False
    name: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of cells; numbers are shown with three significant digits."""

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""


@dataclasses.dataclass(frozen=True)
class Section:
    """One part of a report.

    Attributes:
      text: paragraphs.
      notes: sentences shown as a list, numbered if `ordered`.
      verdict: a highlighted sentence, with `tone` "good", "warn" or "neutral".
      folded: the table is hidden behind a click.
      folded_figures: what a click shows the figures for; "" if they stand open.
    """

    title: str
    text: Sequence[str] = ()
    notes: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    table: Table | None = None
    verdict: str = ""
    tone: str = "neutral"
    folded: bool = False
    folded_figures: str = ""
    ordered: bool = False


class Report:
    """Sections under one title."""

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self.sections: list[Section] = []

    def add(self, section: Section) -> None:
        """Append a section."""
        self.sections.append(section)

    def html(self) -> str:
        """The whole page."""
        source = resources.files("tcbi_infer.report").joinpath("page.html").read_text(encoding="utf-8")
        environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        environment.filters["cell"] = cell
        written = datetime.datetime.now().astimezone().isoformat(timespec="minutes")
        template = environment.from_string(source)
        return template.render(title=self.title, lead=self.lead, sections=self.sections, written=written)

    def write(self, path: Path | str) -> Path:
        """Write the page, whole or not at all.

        Raises:
          InferError: the folder cannot be written.
        """
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, self.html())
        except OSError as e:
            raise InferError(f"cannot write the report {path}: {e.strerror}; choose another place") from e
        return path

    def write_figures(self, folder: Path) -> None:
        """Write each figure that has a name as an SVG file, on white.

        Raises:
          InferError: the folder cannot be written.
        """
        named = [figure for section in self.sections for figure in section.figures if figure.name]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for figure in named:
                alone = figure.svg.replace("<svg", '<svg style="background:#fff;color:#222"', 1)
                (folder / f"{figure.name}.svg").write_text(alone, encoding="utf-8")
        except OSError as e:
            raise InferError(f"cannot write figures to {folder}: {e.strerror}; choose another place") from e


def file_name(kind: str, model: str, rollouts: Sequence[str] = ()) -> str:
    """A report's file name by model version and rollouts: another model or other rollouts overwrite nothing."""
    if not rollouts:
        return f"{kind}-{model}.html"
    digest = hashlib.sha256("\n".join(sorted(rollouts)).encode()).hexdigest()[:6]
    return f"{kind}-{model}-{len(rollouts)}-rollouts-{digest}.html"


def cell(value: Any) -> str:
    """A table cell as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "–" if value != value else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return "–" if value is None else str(value)
