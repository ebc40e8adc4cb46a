"""What a command line may say: a parser whose faults are one line, and types that name the value and what is allowed.

parser.add_argument("--n", type=at_least(1))               # an int
parser.add_argument("--rate", type=above(0.0))             # a float
parser.add_argument("--port", type=between(1, 65_535))
parser.add_argument("--namespace", type=namespace)         # without slashes at its ends
parser.add_argument("--robots", type=not_empty)
parser.add_argument("--diagnosis", type=existing_file)
parser.add_argument("--report", type=new_file)
parser.add_argument("--store", type=folder_path)           # there, or to be made
"""

import argparse
import errno
import math
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

USAGE = 2  # exit status


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, instead of all options first."""

    def error(self, message: str) -> NoReturn:
        """End with the status of wrong usage."""
        text = " ".join(message.removeprefix("argument ").split())
        self.exit(USAGE, f"tcbi: {text}; {self.prog} --help explains\n")


def at_least(low: float) -> Callable[[str], Any]:
    """A number that is `low` or more, of the kind of `low`."""
    return _number(type(low), lambda value: value >= low, f"{low:g} or more")


def above(low: float) -> Callable[[str], Any]:
    """A number that is more than `low`, of the kind of `low`."""
    return _number(type(low), lambda value: value > low, f"more than {low:g}")


def between(low: float, high: float) -> Callable[[str], Any]:
    """A number from `low` to `high`, of the kind of `low`."""
    return _number(type(low), lambda value: low <= value <= high, f"{low} to {high}")


def _number(kind: type, fits: Callable[[Any], bool], allowed: str) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        try:
            value = kind(text)
            good = math.isfinite(value) and fits(value)
        except (ValueError, OverflowError):  # no number, or one too long for a float
            good = False
        if not good:
            whole = "a whole number, " if kind is int else "a number, "
            raise argparse.ArgumentTypeError(f"got {text!r}, allowed is {whole}{allowed}")
        return value

    return parse


def not_empty(text: str) -> str:
    """A text that says something: an unset variable of a shell does not."""
    if not text.strip():
        raise argparse.ArgumentTypeError("got an empty text; say something, or leave the option out")
    return text


timestep = between(1e-5, 0.01)  # s of a simulation; over longer ones the integrator's error passes for the model's
seed = between(0, 2**32 - 1)  # what the libraries of a training and of the methods take


def namespace(text: str) -> str:
    """A namespace of the graph, without slashes at its ends."""
    name = text.strip("/")
    if name and not re.fullmatch(r"[a-z_]\w*(/[a-z_]\w*)*", name, re.ASCII | re.IGNORECASE):
        raise argparse.ArgumentTypeError(
            f"got {text!r}, allowed are letters, digits and _, with / between parts that begin with no digit"
        )
    return name


def new_file(text: str) -> Path:
    """A file that can be written, tried before hours of work; folders on the way need not be there yet."""
    path = Path(text).expanduser()
    there = next(folder for folder in path.absolute().parents if folder.exists())
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as e:
        raise argparse.ArgumentTypeError(f"got {text!r}, which cannot be written: {e.strerror}; name a file") from None
    return path


def existing_file(text: str) -> Path:
    """The path of a file that is there."""
    path = Path(text).expanduser()
    if not path.is_file():
        raise argparse.ArgumentTypeError(f"got {text!r}, allowed is a file, and there is none of this name")
    return path


def folder_path(text: str) -> Path:
    """The path of a folder that is there or can be made."""
    path = Path(text).expanduser()
    there = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not there.is_dir():
        raise argparse.ArgumentTypeError(f"got {text!r}, allowed is a folder, and {there} is a file")
    return path


def node_parameter(text: str) -> tuple[str, str, str]:
    """A node, one of its parameters, and the text of its value: NODE.PARAMETER=VALUE."""
    found = re.fullmatch(r"(\w+)\.(\w+)=(.*)", text, re.ASCII | re.DOTALL)
    if not found:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, allowed is NODE.PARAMETER=VALUE, e.g. inference_node.posterior_moved=1.0"
        )
    return found[1], found[2], found[3]
