"""What the commands share: arguments, output and progress.

    def add_arguments(parser):
        console.add_examples(parser, "./tcbi compare bags/*", "./tcbi compare bag --model hexapod-v1 --json")
        console.add_json(parser)
        console.add_store(parser)                      # --store FOLDER, or None, as ModelStore takes it

    def run(args) -> int:
        with console.progress("recording", total=8, unit="rollouts") as advance:   # on stderr, see progress.py
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
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.arguments import at_least, folder_path, new_file
from tcbi_bringup.progress import progress as progress
from tcbi_contract.plain import plain

if TYPE_CHECKING:
    from tcbi_bringup.robot_graph import GraphOptions
    from tcbi_sim.measurement import Measurement
    from tcbi_sim.model import Model
    from tcbi_sim.store import ModelStore


def add_examples(parser: argparse.ArgumentParser, *examples: str) -> None:
    """Show example calls below the options of `--help`."""
    parser.epilog = "examples:\n" + "\n".join(f"  {example}" for example in examples)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def add_robot_link(parser: argparse.ArgumentParser) -> None:
    """How a real robot is reached besides its port, and what it is like."""
    parser.add_argument(
        "--sensor-port", default="", metavar="PORT", help="the sensor board's own port, where it has one"
    )
    parser.add_argument(
        "--calibration",
        default="",
        metavar="FILE",
        help="the robot's calibration (docs/driver.md); default: the shipped one",
    )
    for option, what in (
        ("--baud-rate", "of the robot's port"),
        ("--sensor-baud-rate", "of the sensor board's own port"),
    ):
        parser.add_argument(
            option, type=at_least(9_600), default=0, metavar="BIT/S", help=f"{what}; default: the driver's own"
        )


def graph_options(args: argparse.Namespace, **more: Any) -> "GraphOptions":
    """What a command line says of a graph: of the robot and its link, task, model, namespace, seed and store."""
    from tcbi_bringup.robot_graph import GraphOptions

    return GraphOptions(
        robot=args.robot,
        task=args.task,
        model=args.model or "latest",
        namespace=args.namespace,
        store=store_folder(args.store),
        seed=args.seed,
        sensor_port=args.sensor_port,
        calibration=args.calibration,
        baud_rate=args.baud_rate,
        sensor_baud_rate=args.sensor_baud_rate,
        hidden=args.hidden,
        strength=args.strength,
        **more,
    )


def add_hidden(parser: argparse.ArgumentParser, strength: str = "") -> None:
    """What is hidden in an emulated robot.

    Args:
      parser: to add to.
      strength: where a call gives none; "" where the robot may be another, so that it is seen that none was given.
    """
    from tcbi_bringup.emulated_robot.hidden_names import DRAWN, STRENGTHS, hidden

    parser.add_argument(
        "--hidden",
        type=hidden,
        default="",
        metavar="EFFECT",
        help="what is hidden in an emulated robot: an effect of the library, one outside it, several joined by +, or "
        f"none; docs/emulated_robot.md lists them (default: drawn from the seed: {', '.join(DRAWN)})",
    )
    parser.add_argument(
        "--strength", choices=STRENGTHS, default=strength, help=f"of what is hidden (default: {STRENGTHS[0]})"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """`--json`: one object on standard output, everything else on standard error."""
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output and nothing else there")


def add_store(parser: argparse.ArgumentParser) -> None:
    """`--store FOLDER`; pass on None, for which ModelStore knows the default."""
    parser.add_argument(
        "--store",
        type=folder_path,
        metavar="FOLDER",
        help="where models, policies, rollouts and runs are kept (default: TCBI_STORE or ~/.local/share/tcbi)",
    )


def add_bags(parser: argparse.ArgumentParser, use: str = "", least: int = 1) -> None:
    """`BAG …` and `--namespace NAME`, for `read_bags`; what for, where they are optional."""
    text = f"bags, or folders of bags{use}"
    parser.add_argument("bags", nargs="+" if least else "*", type=Path, metavar="BAG", help=text)
    parser.add_argument("--namespace", metavar="NAME", help="of the robot to read, where bags hold several robots")


def read_bags(args: argparse.Namespace) -> "list[Measurement]":
    """The rollouts of `add_bags`, none where no bag was given; which of the paths are left out is said."""
    from tcbi_infer.bags.files import left_out
    from tcbi_infer.bags.reader import read_measurements

    for path, why in left_out(args.bags).items():
        note(f"note: {path} is left out: {why}; give it alone to read it")
    return read_measurements(args.bags, None, args.namespace, lambda why: note(f"note: left out: {why}"))


def note_findings(measurements: "Sequence[Measurement]") -> list[str]:
    """Say what the reader had to leave out of recordings, and what is odd in them; returns the sentences."""
    from tcbi_infer.compare.guards import guard

    findings = guard(measurements)
    for finding in findings:
        note(f"note: {finding}")
    return findings


def add_model(parser: argparse.ArgumentParser, use: str = "model version") -> None:
    """`--model VERSION`."""
    parser.add_argument("--model", default="latest", metavar="VERSION", help=f"{use} (default: the newest)")


def add_task(parser: argparse.ArgumentParser, use: str = "", default: str = "", required: bool = False) -> None:
    """`--task NAME`; `cli` refuses one that there is not, before the command runs."""
    text = f"balance, forward, or one of your own{use}" + (f" (default: {default})" if default else "")
    parser.add_argument("--task", default=default, required=required, help=text)


def add_workers(parser: argparse.ArgumentParser) -> None:
    """`--workers WHERE`; `cli` has them ready while the command runs."""
    parser.add_argument(
        "--workers",
        type=_workers,
        metavar="WHERE",
        help="simulate with Ray, an optional extra (docs/scale.md), with the same results: ray (this machine), "
        "ray:HOST:PORT (a cluster by its head's address), ray:auto (the cluster that this machine is in); "
        "default: this process",
    )


def _workers(text: str) -> str:
    from tcbi_sim.workers import WorkersError, address_of

    try:
        address_of(text)
    except WorkersError as e:
        raise argparse.ArgumentTypeError(str(e).removeprefix("workers: ")) from None
    return text


def load_model(store: "ModelStore", version: str, rig: str = "hexapod") -> "Model":
    """A model version; where none was named, which one is the newest is said on standard error."""
    model = store.load(version, rig)
    note_model(version, model.version)
    return model


def note_model(asked: str, used: str) -> None:
    """Say which model version is used, unless it was asked for by its name."""
    if asked != used:
        note(f"model {used}, the newest; --model names another")


def add_report(parser: argparse.ArgumentParser) -> None:
    """`--report FILE`."""
    parser.add_argument("--report", type=new_file, metavar="FILE", help="the HTML report (default: in the store)")


def store_folder(given: Path | None) -> Path:
    """The folder that `--store` stands for, absolute; the rule of `tcbi_sim.store`, without its imports."""
    default = Path(os.environ.get("TCBI_STORE") or Path.home() / ".local" / "share" / "tcbi")
    return (given or default).expanduser().absolute()


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
    data = f"{text}\n".encode(errors="backslashreplace")  # a file's name may be no text
    if not _answer_to:
        print(data.decode(), end="", flush=True)
        return
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
        numeric = bool(rows) and all(isinstance(row[i], float) or _is_number(row[i]) or row[i] is None for row in rows)
        grid.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        grid.add_row(*(_cell(value) for value in row))
    width = None if sys.stdout.isatty() else 120
    printer = rich.console.Console(width=width, highlight=False, markup=False)
    with printer.capture() as text:
        printer.print(grid)
    print(text.get(), end="")  # not by rich, which makes an error of a reader that has gone


def ladder(errors: Sequence[tuple[str, float]], judged: str = "") -> None:
    """The error ladder on standard output: the noise floor, each model, and what the last one leaves unexplained.

    Args:
      errors: label and error over noise floor of each model; infinite where it diverges.
      judged: the motions that the errors are of, where not all were compared.
    """
    from tcbi_infer.compare.ladder import unexplained

    rungs = [("noise floor", 1.0), *errors, ("left unexplained", unexplained(errors[-1][1]))]
    print(f"error over noise floor, joints and attitude{judged and f', {judged}'}:")
    for label, error in rungs:
        if not math.isnan(error):
            print(f"  {f'{error:.2f}' if math.isfinite(error) else 'diverges':>8}  {label}")


def _is_number(value: Any) -> bool:
    return isinstance(plain(value), (int, float)) and not isinstance(plain(value), bool)


def _cell(value: Any) -> str:
    if isinstance(value, float) and math.isinf(value):
        return str(value)  # an error where the simulation diverged, which JSON has no number for
    value = plain(value)
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
