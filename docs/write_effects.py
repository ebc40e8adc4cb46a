"""Writes the table of docs/effects.md from the library itself: `./tcbi python docs/write_effects.py`."""

from pathlib import Path

from tcbi_sim.effects import built_in
from tcbi_sim.rigs import RIGS, load_rig

PAGE = Path(__file__).with_name("effects.md")
BEGIN, END = "<!-- table: written by docs/write_effects.py -->", "<!-- end of the table -->"


def text() -> str:
    """The page with its table as the code is."""
    head, _, rest = PAGE.read_text().partition(BEGIN)
    return f"{head}{BEGIN}\n{table()}\n{END}{rest.partition(END)[2]}"


def table() -> str:
    """One line for each parameter of each built-in effect."""
    rows = ["| effect | rigs | parameter | range (prior) | nominal | null | what it is |", "| --- " * 7 + "|"]
    for effect in built_in().values():
        rigs = ", ".join(name for name in RIGS if not effect.requires(load_rig(name)))
        for k, p in enumerate(effect.parameters):
            first = f"`{effect.name}` | {rigs}" if k == 0 else " | "
            unit = "" if p.unit == "1" else f" {p.unit}"
            log = ", log" if p.scale == "log" else ""
            null = "–" if p.null is None else f"{p.null:g}"
            prior = f"{p.low:g} to {p.high:g}{unit}{log}"
            rows.append(f"| {first} | `{p.name}` | {prior} | {p.nominal:g} | {null} | {p.description} |")
    return "\n".join(rows)


if __name__ == "__main__":
    PAGE.write_text(text())
