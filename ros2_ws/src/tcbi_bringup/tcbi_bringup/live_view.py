"""Shows a running graph: a live table on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence

import rich.box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tcbi_bringup.expectations import EXPECTATIONS, Expectation, judge_rate
from tcbi_bringup.graph_monitor import Complaint, TopicRate
from tcbi_bringup.launcher import ProcessStatus, describe_exit

REFRESH_S = 0.5
LINE_PERIOD_S = 10.0
STATE_STYLES = {"running": "green", "waiting": "yellow", "given up": "bold red", "ended": "dim"}
LEVEL_STYLES = {"error": "bold red"}  # all other levels of a complaint are yellow

Look = Callable[[], tuple[Sequence[ProcessStatus], Mapping[str, TopicRate], Sequence[Complaint]]]


def show(title: str, look: Look, goes_on: Callable[[], bool], simulated: bool = False) -> None:
    """Show the graph until `goes_on` says no.

    Args:
      title: one line that stays above.
      look: gives the present state.
      goes_on: asked several times a second.
      simulated: the graph runs on a simulated clock, so that rates by the wall say nothing.
    """
    if sys.stdout.isatty():
        _show_live(title, look, goes_on, simulated)
    else:
        _show_lines(title, look, goes_on)


def _show_live(title: str, look: Look, goes_on: Callable[[], bool], simulated: bool) -> None:
    console = Console()
    with Live(console=console, auto_refresh=False) as live:
        while goes_on():
            processes, rates, complaints = look()
            tables = process_table(processes), topic_table(rates, simulated)
            lines = [Text(complaint_line(c), style=LEVEL_STYLES.get(c.level, "yellow")) for c in complaints]
            hint = Text("Ctrl-C stops all", style="dim")
            live.update(Group(Text(title), *tables, *lines, hint), refresh=True)
            time.sleep(REFRESH_S)


def _show_lines(title: str, look: Look, goes_on: Callable[[], bool]) -> None:
    print(title, flush=True)
    known: dict[str, tuple[str, int]] = {}
    told: set[Complaint] = set()
    shown = time.monotonic()
    while goes_on():
        processes, rates, complaints = look()
        for p in processes:
            if known.get(p.name) != (p.state, p.restarts):
                known[p.name] = (p.state, p.restarts)
                print(process_line(p), flush=True)
        for complaint in complaints:
            if complaint not in told:
                print(complaint_line(complaint), flush=True)
        told = set(complaints)
        if time.monotonic() - shown >= LINE_PERIOD_S:
            shown = time.monotonic()
            print(rate_line(rates), flush=True)
        time.sleep(REFRESH_S / 5)


def process_table(processes: Sequence[ProcessStatus]) -> Table:
    """Nodes, with state, process id, restarts and time since their start."""
    table = Table(box=rich.box.SIMPLE_HEAD, pad_edge=False)
    for column, justify in (("process", "left"), ("state", "left"), ("pid", "right"), ("restarts", "right")):
        table.add_column(column, justify="right" if justify == "right" else "left")
    table.add_column("up", justify="right")
    table.add_column("last end")
    for p in processes:
        table.add_row(
            p.name,
            Text(p.state, style=STATE_STYLES[p.state]),
            str(p.pid or "–"),
            str(p.restarts),
            f"{time.time() - p.started:.0f} s" if p.state == "running" else "–",
            Text(p.reason or (describe_exit(p.exit_code) if p.exit_code is not None else "–")),  # no markup: [/dev/…]
        )
    return table


def topic_table(rates: Mapping[str, TopicRate], simulated: bool = False) -> Table:
    """Topics, with the rate of the contract, the rate seen, the age of the last message, and publishers."""
    table = Table(box=rich.box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("topic")
    for column in ("contract", "seen", "age", "publishers"):
        table.add_column(column, justify="right")
    for expected in EXPECTATIONS:
        seen = rates.get(expected.topic)
        if seen is None:
            continue
        table.add_row(
            expected.topic,
            f"{expected.rate_hz:g} Hz" if expected.rate_hz else "any",
            Text(f"{seen.rate_hz:.1f} Hz", style="" if simulated else rate_style(expected, seen.rate_hz)),
            "–" if seen.age_s is None else f"{seen.age_s:.1f} s",
            str(seen.publishers),
        )
    return table


def rate_style(expected: Expectation, seen_hz: float) -> str:
    """Red where what should always flow does not, yellow for a rate that the contract does not allow."""
    if not seen_hz:
        return "bold red" if expected.always else ""
    return "" if expected.rate_hz is None or judge_rate(expected.rate_hz, seen_hz) else "yellow"


def complaint_line(complaint: Complaint) -> str:
    """What is not well, in one line."""
    return f"{complaint.level}: {complaint.source}: {complaint.message}"


def process_line(p: ProcessStatus) -> str:
    """One process in one line."""
    words = [f"{p.name}: {p.state}"]
    words += [f"pid {p.pid}"] if p.pid else []
    words += [f"restarts {p.restarts}"] if p.restarts else []
    words += [p.reason or f"last end: {describe_exit(p.exit_code)}"] if p.exit_code is not None else []
    return ", ".join(words)


def rate_line(rates: Mapping[str, TopicRate]) -> str:
    """All rates in one line."""
    return "; ".join(f"{topic} {seen.rate_hz:.1f} Hz" for topic, seen in rates.items())
