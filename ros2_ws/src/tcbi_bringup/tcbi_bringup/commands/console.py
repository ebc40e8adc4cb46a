"""What the commands share: arguments, output and progress.

    def add_arguments(parser):
        console.add_examples(parser, "./tcbi compare bags/*", "./tcbi compare bag --model hexapod-v1 --json")
        console.add_json(parser)
        console.add_store(parser)                      # --store FOLDER, or None, as ModelStore takes it

    def run(args) -> int:
        with console.progress("simulating", total=50) as advance:   # bar with ETA, or lines, on stderr
            for ... : advance(1)                       # or advance(done=12), advance(note="generation 3")
        console.note("read 3 bags")                    # a line for people on standard error
        if args.json:
            console.emit(result)                       # one JSON object on standard output; numpy-safe, NaN -> null
        else:
            console.table("title", ["signal", "error"], rows)

Errors are raised as TcbiError; `cli` prints them in one line and exits with 1.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

LINE_PERIOD_S = 10.0  # between two lines of progress where standard error is no terminal


def add_examples(parser: argparse.ArgumentParser, *examples: str) -> None:
    """Show example calls below the options of `--help`."""
    parser.epilog = "examples:\n" + "\n".join(f"  {example}" for example in examples)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def add_json(parser: argparse.ArgumentParser) -> None:
    """`--json`: one object on standard output, everything else on standard error."""
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output and nothing else there")


def add_store(parser: argparse.ArgumentParser) -> None:
    """`--store FOLDER`; pass on None, for which ModelStore knows the default."""
    parser.add_argument(
        "--store",
        type=Path,
        metavar="FOLDER",
        help="where models, policies, rollouts and runs are kept (default: TCBI_STORE or ~/.local/share/tcbi)",
    )


def add_bags(parser: argparse.ArgumentParser, use: str = "", least: int = 1) -> None:
    """`BAG …`; what for, where they are optional."""
    text = f"bags, or folders of bags{use}"
    parser.add_argument("bags", nargs="+" if least else "*", type=Path, metavar="BAG", help=text)


def add_model(parser: argparse.ArgumentParser, use: str = "model version") -> None:
    """`--model VERSION`."""
    parser.add_argument("--model", default="latest", metavar="VERSION", help=f"{use} (default: the newest)")


def add_report(parser: argparse.ArgumentParser) -> None:
    """`--report FILE`."""
    parser.add_argument("--report", type=Path, metavar="FILE", help="the HTML report (default: in the store)")


def store_folder(given: Path | None) -> Path:
    """The folder that `--store` stands for, absolute; the rule of `tcbi_sim.store`, without its imports."""
    default = Path(os.environ.get("TCBI_STORE") or Path.home() / ".local" / "share" / "tcbi")
    return (given or default).expanduser().absolute()


def plain(value: Any) -> Any:
    """A value as JSON knows it: numpy as numbers and lists, dataclasses as objects, NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (str, int, bool)) or value is None:
        return value
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in (sorted(value) if isinstance(value, (set, frozenset)) else value)]
    return str(value)


STANDARD_OUTPUT, STANDARD_ERROR = 1, 2  # file descriptors
_answer_to: list[int] = []  # the file descriptor of the real standard output, while `json_only` keeps all else off it


@contextlib.contextmanager
def json_only() -> Iterator[None]:
    """Keep standard output for `emit` alone: what anybody else writes there, a C++ library too, goes to standard error.

    Where standard output is no file of the system's (a test that captures it), nothing is redirected.
    """
    try:
        redirects = sys.stdout.fileno() == STANDARD_OUTPUT
    except (AttributeError, OSError):  # closed, or no file
        redirects = False
    if not redirects:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(STANDARD_OUTPUT)
    _answer_to.append(kept)
    os.dup2(STANDARD_ERROR, STANDARD_OUTPUT)
    try:
        yield
    finally:
        sys.stdout.flush()
        _answer_to.pop()
        os.dup2(kept, STANDARD_OUTPUT)
        os.close(kept)


def emit(result: Any) -> None:
    """Print one JSON object to standard output."""
    text = json.dumps(plain(result), indent=2, ensure_ascii=False, allow_nan=False)
    if not _answer_to:
        print(text, flush=True)
        return
    data = f"{text}\n".encode()
    while data:
        data = data[os.write(_answer_to[-1], data) :]


def note(text: str) -> None:
    """One line for people, on standard error."""
    print(text, file=sys.stderr, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """A table for people on standard output; numbers right, with four significant digits."""
    import rich.box
    import rich.console
    import rich.table

    grid = rich.table.Table(title=title or None, title_justify="left", box=rich.box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        numeric = bool(rows) and all(_is_number(row[i]) or row[i] is None for row in rows)
        grid.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        grid.add_row(*(_cell(value) for value in row))
    width = None if sys.stdout.isatty() else 120
    rich.console.Console(width=width, highlight=False, markup=False).print(grid)


def _is_number(value: Any) -> bool:
    return isinstance(plain(value), (int, float)) and not isinstance(plain(value), bool)


def _cell(value: Any) -> str:
    value = plain(value)
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextlib.contextmanager
def progress(text: str, total: float | None = None) -> Iterator[Callable[..., None]]:
    """Progress of one piece of work on standard error: a bar with the time left, or plain lines if no terminal.

    Args:
      text: what is being done.
      total: number of steps, None while unknown.

    Yields: `advance(steps=1, *, done=None, total=None, note=None)`; `done` sets the count instead of adding to it.
    """
    reporter = _Bar(text, total) if sys.stderr.isatty() else _Lines(text, total)
    try:
        yield reporter.advance
    finally:
        reporter.close()


class _Bar:
    def __init__(self, text: str, total: float | None) -> None:
        import rich.console
        from rich import progress as bars

        self._text = text
        self._progress = bars.Progress(
            bars.TextColumn("{task.description}"),
            bars.BarColumn(bar_width=30),
            bars.MofNCompleteColumn(),
            bars.TimeElapsedColumn(),
            bars.TextColumn("left"),
            bars.TimeRemainingColumn(),
            console=rich.console.Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task(text, total=total)
        self._progress.start()

    def advance(
        self, steps: float = 1, *, done: float | None = None, total: float | None = None, note: str | None = None
    ) -> None:
        changes: dict[str, Any] = {"completed": done} if done is not None else {"advance": steps}
        if total is not None:
            changes["total"] = total
        if note is not None:
            changes["description"] = f"{self._text}: {note}"
        self._progress.update(self._task, **changes)

    def close(self) -> None:
        self._progress.stop()


class _Lines:
    def __init__(self, text: str, total: float | None) -> None:
        self._text, self._total, self._done, self._note = text, total, 0.0, ""
        self._began = self._shown = time.monotonic()

    def advance(
        self, steps: float = 1, *, done: float | None = None, total: float | None = None, note: str | None = None
    ) -> None:
        self._done = done if done is not None else self._done + steps
        self._total = total if total is not None else self._total
        self._note = note if note is not None else self._note
        if time.monotonic() - self._shown >= LINE_PERIOD_S:
            self._show()

    def _show(self) -> None:
        self._shown = time.monotonic()
        elapsed = self._shown - self._began
        words = [f"{self._text}: {self._done:g}" + (f"/{self._total:g}" if self._total else ""), f"{elapsed:.0f} s"]
        if self._total and self._done:
            words.append(f"{max(0.0, elapsed * (self._total / self._done - 1)):.0f} s left")
        note(", ".join(words + ([self._note] if self._note else [])))

    def close(self) -> None:
        if self._shown > self._began:
            self._show()
