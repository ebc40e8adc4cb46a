"""How far a diagnosis's answer goes: whether all motions give the same, and what the rest of the error goes with."""

from collections.abc import Sequence
from typing import Any

from tcbi_contract.wording import with_unit
from tcbi_infer.diagnose.evidence import Agreement, Leftover
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
        "share of the squared error / %",
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


def agreement_section(found: Sequence[Agreement], use: str) -> Section:
    """Each parameter's value in each kind of motion alone."""
    model = f"the model with {use}" if use else "the model without any new effect"
    kinds = list(dict.fromkeys(k.kind for a in found for k in a.kinds))
    own = [{k.kind: f"{k.value:.3g} ({k.low90:.3g} to {k.high90:.3g})" for k in a.kinds} for a in found]
    agree = {True: "yes", False: "no", None: "cannot be told"}
    rows: list[list[Any]] = [[kind, *(values.get(kind, "–") for values in own)] for kind in kinds]
    rows += [["all together", *(a.value for a in found)], ["do they agree?", *(agree[a.agrees] for a in found)]]
    rows.append(["p", *("–" if a.p is None else a.p for a in found)])
    told = [a.statement for a in found if a.agrees is False]
    return Section(
        "Do the motions agree on the values?",
        text=[
            f"Each kind of motion alone, beginning from the common fit of {model}, with its 90 % interval; a dash "
            "where it hardly knows the parameter. p is how often errors as large and as smooth as those of the model, "
            "but unrelated to the parameter, would set the values as far apart; a spread small beside the value "
            "counts as agreement all the same."
        ],
        notes=told or ["No parameter's values disagree between the kinds of motion, as far as these can tell."],
        table=Table(["motion", *(with_unit(a.name, f"/ {a.unit}" if a.unit != "1" else "") for a in found)], rows),
        folded=True,
    )
