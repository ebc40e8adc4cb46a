"""What of a diagnosis says how far its answer goes: what the rest of the error goes with."""

from tcbi_infer.diagnose.evidence import Leftover
from tcbi_infer.report import plots
from tcbi_infer.report.page import Figure, Section, Table


def leftover_section(leftover: Leftover) -> Section:
    """How much could be explained at all, and by which recorded variable."""
    model = f"the model with {leftover.use}" if leftover.use else "the model without any new effect"
    text = [
        f"What {model} gets wrong in the joints' positions was set against what was recorded at the same moment, each "
        "variable with a law of its own, fitted to the other kinds of motion than the one it was judged on. A bar is "
        "the share of the squared error beyond the noise that one variable alone takes away, a constant offset "
        "aside; the whisker is its standard error between kinds of motion. What no bar explains may depend on "
        "something that was not recorded, or on what happened before."
    ]
    if not leftover.variables:
        return Section("What does the rest of the error go with?", notes=[leftover.statement])
    rows = leftover.variables
    svg = plots.bars(
        [v.name for v in rows],
        [100 * v.share for v in rows],
        [100 * v.se for v in rows],
        [v.sure for v in rows],
        "explained / % of the squared error beyond the noise",
    )
    caption = "What each variable alone explains; in colour where the kinds of motion agree that it does."
    cells = [[v.name, 100 * v.share, 100 * v.se, v.sure] for v in rows]
    return Section(
        "What does the rest of the error go with?",
        text=text,
        notes=[leftover.statement],
        figures=[Figure(svg, caption, wide=True)],
        table=Table(["variable", "share / %", "s.e.", "sure?"], cells),
        folded=True,
    )
