"""Shows a running graph: a live table on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence

import rich.box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tcbi_bringup.expectations import EXPECTATIONS, judge_rate
from tcbi_bringup.graph_monitor import TopicRate
from tcbi_bringup.launcher import ProcessStatus, describe_exit

REFRESH_S = 0.5
LINE_PERIOD_S = 10.0
STATE_STYLES = {"running": "green", "waiting": "yellow", "given up": "bold red", "ended": "dim"}

Look = Callable[[], tuple[Sequence[ProcessStatus], Mapping[str, TopicRate]]]


def show(title: str, look: Look, goes_on: Callable[[], bool]) -> None:
    """Show the graph until `goes_on` says no.

    Args:
      title: one line that stays above.
      look: gives the present state.
      goes_on: asked several times a second.
    """
    if sys.stdout.isatty():
        _show_live(title, look, goes_on)
    else:
        _show_lines(title, look, goes_on)


def _show_live(title: str, look: Look, goes_on: Callable[[], bool]) -> None:
    console = Console()
    with Live(console=console, auto_refresh=False) as live:
        while goes_on():
            processes, rates = look()
            hint = Text("Ctrl-C stops all", style="dim")
            live.update(Group(Text(title), process_table(processes), topic_table(rates), hint), refresh=True)
            time.sleep(REFRESH_S)


def _show_lines(title: str, look: Look, goes_on: Callable[[], bool]) -> None:
    print(title, flush=True)
    known: dict[str, tuple[str, int]] = {}
    shown = time.monotonic()
    while goes_on():
        processes, rates = look()
        for p in processes:
            if known.get(p.name) != (p.state, p.restarts):
                known[p.name] = (p.state, p.restarts)
                print(process_line(p), flush=True)
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


def topic_table(rates: Mapping[str, TopicRate]) -> Table:
    """Topics, with the rate of the contract, the rate seen, the age of the last message, and publishers."""
    table = Table(box=rich.box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("topic")
    for column in ("contract", "seen", "age", "publishers"):
        table.add_column(column, justify="right")
    for expected in EXPECTATIONS:
        seen = rates.get(expected.topic)
        if seen is None:
            continue
        good = expected.rate_hz is None or not seen.rate_hz or judge_rate(expected.rate_hz, seen.rate_hz)
        table.add_row(
            expected.topic,
            f"{expected.rate_hz:g} Hz" if expected.rate_hz else "any",
            Text(f"{seen.rate_hz:.1f} Hz", style="" if good else "yellow"),
            "–" if seen.age_s is None else f"{seen.age_s:.1f} s",
            str(seen.publishers),
        )
    return table


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
