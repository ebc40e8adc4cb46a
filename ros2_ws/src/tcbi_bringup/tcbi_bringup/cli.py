"""The `tcbi` command: a table of commands, each in a module of its own that is imported only when it is called."""

import argparse
import contextlib
import difflib
import errno
import importlib
import importlib.util
import io
import keyword
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from tcbi_bringup.arguments import USAGE, Parser, folder_path
from tcbi_bringup.errors import WrongCallError
from tcbi_contract.errors import TcbiError, UsageError

OK, FAULT, INTERRUPTED = 0, 1, 130
READER_GONE = 141  # as a shell reports a program that a closed pipe has ended

_ROOM = "make room on the disk, or choose another folder (--store or --out)"
_RIGHTS = "give yourself the right to read or write there, or choose another folder (--store or --out)"
_PLACE = "a file is where a folder should be: move it away, or choose another folder (--store or --out)"
MACHINE_FAULTS = {  # what any command may meet, and what to do; other errors of the system are faults of the program
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: "the limit on the size of files is too low: raise it (ulimit -f unlimited)",
    errno.EROFS: _RIGHTS,
    errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
    errno.ENOTDIR: _PLACE,
    errno.EEXIST: _PLACE,
    errno.EISDIR: "a folder is where a file should be: give the path of a file",
    errno.ENAMETOOLONG: "the file system takes no name of this length: choose a shorter one",
    errno.EIO: "the disk fails: see what the kernel says (dmesg), or choose another folder (--store or --out)",
}
OWN_PACKAGES = ("tcbi_", "hexapod_driver")
INSTALL = "activate the environment with what requirements-pypi.txt lists, or make it (docs/setup.md)"


@dataclass(frozen=True)
class Command:
    """One line of the table.

    Attributes:
      name: as typed.
      group: heading in `--help`.
      summary: one line, kept here so that `--help` imports nothing.
    """

    name: str
    group: str
    summary: str

    @property
    def module(self) -> str:
        """Where the command lives; `import` is a word of the language, so its module is `import_`."""
        name = self.name.replace("-", "_")
        return f"tcbi_bringup.commands.{name}{'_' if keyword.iskeyword(name) else ''}"


GROUPS = {
    "start": "Start here",
    "record": "1. Record",
    "compare": "2. Compare, locate",
    "explain": "3. Explain, add",
    "infer": "4. Infer, retrain",
    "watch": "5. Watch",
    "graph": "The graph",
    "develop": "For developers",
}

COMMANDS = (
    Command("demo", "start", "the whole loop on an emulated robot with a hidden effect"),
    Command("up", "start", "start the graph of nodes: on a simulation, an emulated robot or a real one"),
    Command("dashboard", "start", "the whole loop in a browser"),
    Command("doctor", "start", "check environment, ports, topics and rates, and say what to do"),
    Command("collect", "record", "record rollouts of a task from the running graph, one bag each"),
    Command("import", "record", "turn a log of another format into bags"),
    Command("recover", "record", "repair a bag that was cut off"),
    Command("replay", "record", "play bags into the running graph, at any speed"),
    Command("compare", "compare", "error of a model on bags, per signal and joint, beside the noise floor"),
    Command("diagnose", "explain", "which physical effect is missing: a ranking and a verdict"),
    Command("selftest", "explain", "plant known effects in a model: which of them would a diagnosis find?"),
    Command("effects", "explain", "the library of physical effects; check one of your own"),
    Command("add", "explain", "make a new model version with an effect in it"),
    Command("remove", "explain", "make a new model version without one of its effects"),
    Command("infer", "infer", "posterior of the parameters from bags"),
    Command("tasks", "infer", "list the tasks with their rewards; check one of your own"),
    Command("train", "infer", "train a policy for a task on a model"),
    Command("retrain", "infer", "train the running policy's successor on the posterior"),
    Command("policy", "infer", "list, show and measure policies"),
    Command("model", "watch", "list, show and delete model versions"),
    Command("history", "watch", "the error of each model version"),
    Command("diff", "watch", "what differs between two model versions"),
    Command("export-model", "watch", "write a model version as MJCF"),
    Command("view", "watch", "show a model version, or render a picture and a video"),
    Command("study", "watch", "does it transfer? the paper's experiment on emulated robots, all methods side by side"),
    Command("run", "graph", "start one executable of one package, with --ros-args as usual"),
    Command("bench", "develop", "measure the product: accuracy, speed, robustness"),
    Command("test", "develop", "run linter, type checker and all tests, or the tests of one path"),
)


def available() -> tuple[Command, ...]:
    """Commands whose module is installed (a driver-only machine has fewer)."""
    return tuple(c for c in COMMANDS if importlib.util.find_spec(c.module) is not None)


def overview() -> str:
    """The text of `./tcbi --help`."""
    lines = ["usage: ./tcbi COMMAND [options]      (./tcbi COMMAND --help explains each)", ""]
    for key, title in GROUPS.items():
        commands = [c for c in available() if c.group == key]
        if commands:
            lines += [title, *(f"  {c.name:14} {c.summary}" for c in commands), ""]
    lines += ["  python ARGS    the interpreter of this environment", ""]
    lines += ["  --version      of tcbi, and of what it stands on (with --json)", ""]
    lines += [
        "Exit status: 0 done, 1 the input or the machine is at fault, 2 wrong usage or an unknown name, "
        "130 stopped by Ctrl-C."
    ]
    return "\n".join(lines)


def find(name: str) -> Command | None:
    """The command of that name, or None."""
    return next((c for c in available() if c.name == name), None)


def main(argv: list[str] | None = None) -> int:
    """Run one command line; returns the exit status.

    Args:
      argv: None for the process's own; then SIGTERM ends the command as an exit does, and nothing follows its answer.
    """
    if argv is not None:
        return call(argv)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without a sign shows another one
    status = call(sys.argv[1:])
    if sys.stdout is not None:
        os.dup2(2, 1)  # whatever a library still says at its end is no answer
    return status


def call(words: list[str]) -> int:
    """Run one command line; what a user or the machine is at fault for is one line on standard error."""
    try:
        status = dispatch(words)
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except TcbiError as e:
        print(f"tcbi: {' '.join(str(e).split())}", file=sys.stderr)
        return USAGE if isinstance(e, UsageError) else FAULT
    except KeyboardInterrupt:
        print("tcbi: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.stdout.flush()  # what nobody reads, so that nothing of it is left for later
        return READER_GONE
    except ModuleNotFoundError as e:
        if not e.name or e.name.startswith(OWN_PACKAGES):
            raise
        print(f"tcbi: the Python package {e.name!r} is missing; {INSTALL}", file=sys.stderr)
        return FAULT
    except OSError as e:
        fault = machine_fault(e)
        if not fault:
            raise
        print(f"tcbi: {fault}", file=sys.stderr)
        return FAULT


def machine_fault(error: OSError) -> str:
    """What the machine is at fault for and what to do, in one line; "" where the program is."""
    if error.errno in MACHINE_FAULTS:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{os.strerror(error.errno)}; {MACHINE_FAULTS[error.errno]}"
    if error.errno == errno.ENOENT and not error.filename:
        try:
            tempfile.gettempdir()
        except FileNotFoundError as e:
            return f"{e.strerror}; make room in one of them, or name another folder (TMPDIR)"
    return ""


def dispatch(words: list[str]) -> int:
    """Find the command, parse its arguments, run it."""
    if len(words) == 2 and words[0] == "help":
        words = [words[1], "--help"]
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return OK if words else USAGE
    if words[0] == "--version":
        return version(words[1:])
    command = find(words[0])
    if command is None:
        print(f"tcbi: {unknown(words[0])}", file=sys.stderr)
        return USAGE
    module = importlib.import_module(command.module)
    rest = words[1:]
    if getattr(module, "PASSES_ON", False) and rest[:1] not in (["-h"], ["--help"]):
        rest = ["--", *rest]  # argparse would take a leading option for its own
    rest, own = _divided(rest) if hasattr(module, "TAKES_BEHIND_DASHES") else (rest, [])
    try:
        args = parser_for(command, module).parse_args(rest)
    except SystemExit as e:  # argparse has printed what is wrong, or the help
        return int(e.code or OK)
    if own:
        setattr(args, module.TAKES_BEHIND_DASHES, own)
    with store_of(args):
        if hasattr(module, "prepare"):
            module.prepare(args)
        check_names(args)
        if not getattr(args, "json", False):
            with workers_of(args):
                return int(module.run(args))
        from tcbi_bringup.commands import console

        with console.json_only(), workers_of(args):
            return int(module.run(args))


def _divided(words: list[str]) -> tuple[list[str], list[str]]:
    """What stands before and behind `--`, which argparse loses where an option stands between positional words."""
    at = words.index("--") if "--" in words else len(words)
    return words[:at], words[at + 1 :]


def check_names(args: argparse.Namespace) -> None:
    """Refuse a `--task` or a `--rig` that there is not; those of one's own lie in the store.

    Raises:
      UnknownNameError: with the known ones.
    """
    if getattr(args, "task", ""):
        from tcbi_sim.tasks import find_task

        find_task(args.task)
    if getattr(args, "rig", ""):
        from tcbi_sim.rigs import load_rig

        load_rig(args.rig)


@contextlib.contextmanager
def store_of(args: argparse.Namespace) -> Iterator[None]:
    """`--store` as the store of everything that the command does: one's own effects are looked up there too.

    Raises:
      WrongCallError: TCBI_STORE is no folder and cannot be made one.
    """
    before, given = os.environ.get("TCBI_STORE"), getattr(args, "store", None)
    if given is not None:
        if not Path(given).expanduser().exists():
            print(f"note: there is no store at {given} yet", file=sys.stderr)
        os.environ["TCBI_STORE"] = str(Path(given).expanduser().absolute())
    elif before and hasattr(args, "store"):
        try:
            folder_path(before)
        except argparse.ArgumentTypeError as e:
            raise WrongCallError(f"the environment variable TCBI_STORE: {e}") from None
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("TCBI_STORE", None)
        else:
            os.environ["TCBI_STORE"] = before


@contextlib.contextmanager
def workers_of(args: argparse.Namespace) -> Iterator[None]:
    """`--workers` as those that everything is simulated by that the command simulates."""
    where = getattr(args, "workers", "")
    if not where:
        yield
        return
    from tcbi_sim.workers import workers

    with workers(where):
        yield


def parser_for(command: Command, module: ModuleType) -> argparse.ArgumentParser:
    """The parser of one command, with its summary as description."""
    parser = Parser(
        prog=f"./tcbi {command.name}", description=module.SUMMARY, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    module.add_arguments(parser)
    return parser


def version(options: list[str]) -> int:
    """`./tcbi --version`."""
    parser = Parser(prog="./tcbi --version", description="Version, and with --json that of what tcbi stands on.")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    as_json = parser.parse_args(options).json
    from tcbi_bringup.versions import versions

    found = versions()
    if as_json:
        from tcbi_bringup.commands import console

        console.emit(found)
    else:
        print(f"tcbi {found['tcbi']}" + (f" (commit {found['commit']})" if found["commit"] else ""))
    return OK


def unknown(name: str) -> str:
    """What to say about a command that does not exist."""
    close = difflib.get_close_matches(name, [c.name for c in available()], n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"unknown command {name!r}; {hint}./tcbi --help lists all"


if __name__ == "__main__":
    sys.exit(main())
