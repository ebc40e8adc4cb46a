"""A Python file of the user's own: read without trusting it, and every fault in one plain line."""

import contextlib
import multiprocessing
import re
import signal
import traceback
import types
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from tcbi_contract.errors import TcbiError
from tcbi_sim.errors import SimError

NAME = re.compile(r"[a-z][a-z0-9_]*")
MISSING = re.compile(r"(\w+)\.__init__\(\) missing \d+ required positional arguments?: (.+)")
LIMIT_S = 60  # that a check may take; a good file's takes a few
Value = TypeVar("Value")


class UserFileError(SimError):
    """A user's file that holds nothing usable; `faults` are lines."""

    holds = ""  # what it should hold, in a word

    def __init__(self, path: Path, faults: list[str]):
        self.path, self.faults = path, faults
        super().__init__(f"{f'{self.holds} file {path}'.lstrip()}: {'; '.join(faults)}")


def read(path: Path, attribute: str, error: type[UserFileError] = UserFileError) -> Any:
    """What a file defines under a name, None where it defines nothing of that name.

    It is compiled as it stands, never taken from bytecode, which knows no changes within a second.

    Raises:
      UserFileError: as `error`, the file cannot be imported.
    """
    if not path.exists():
        raise error(path, ["there is no such file"])
    if not path.is_file() or path.suffix != ".py":
        raise error(path, ["is no Python file; give the path of a file that ends in .py"])
    module = types.ModuleType(f"tcbi_user_{path.stem}")
    module.__file__ = str(path)
    try:
        exec(compile(path.read_bytes(), path, "exec"), module.__dict__)
    except (Exception, SystemExit) as e:  # it is the user's code
        raise error(path, [f"cannot be imported: {told(e, path)}"]) from e
    return getattr(module, attribute, None)


def read_one(path: Path, attribute: str, kind: type[Value], error: type[UserFileError]) -> Value:
    """What a file defines under a name, of the kind that it must be.

    Raises:
      UserFileError: as `error`, it cannot be imported, or is of another kind.
    """
    value = read(path, attribute, error)
    if not isinstance(value, kind):
        name, home = kind.__name__, kind.__module__
        seen = "nothing of that name" if value is None else f"a {type(value).__name__}"
        article = "an" if name[0] in "AEIOU" else "a"
        raise error(
            path, [f"{attribute} must be {article} {name} of {home}, seen {seen}; write {attribute} = {name}(…)"]
        )
    return value


def apart(check: Callable[..., Value], path: Path, *more: Any, limit_s: int = LIMIT_S) -> Value:
    """What `check(path, *more)` gives, from a process of its own: the user's code may end its process, or never end.

    Raises:
      UserFileError: it did one of the two.
    """
    spawn = multiprocessing.get_context("spawn")
    answer, other_end = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_answer, args=(other_end, limit_s, check, path, *more))
    process.start()
    other_end.close()
    try:
        return answer.recv()
    except EOFError:
        process.join()
        if process.exitcode == -signal.SIGALRM:
            fault = f"does not end within {limit_s} s; look for a loop that goes on for ever"
        else:
            fault = f"ends the process that runs it, with status {process.exitcode}; raise an exception instead"
        raise UserFileError(path, [fault]) from None
    finally:
        process.kill()
        process.join()


def _answer(to: Connection, limit_s: int, check: Callable[..., Any], *args: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends it
    signal.alarm(limit_s)
    to.send(check(*args))


def python_files(folder: Path) -> list[Path]:
    """Those of a folder, in the order in which they are read; names that begin with _ or . are not."""
    return sorted(p for p in folder.glob("*.py") if not p.name.startswith(("_", ".")))


@contextlib.contextmanager
def included(known: dict[str, Value], name: str, value: Value) -> Iterator[None]:
    """One more in a library for a while, which hides one of the same name."""
    before = dict(known)
    known[name] = value
    try:
        yield
    finally:
        known.clear()
        known.update(before)


def told(error: BaseException, path: Path | str) -> str:
    """An exception of the user's code in a few words, with the line of the file that it came from."""
    if isinstance(error, SyntaxError):
        return f"line {error.lineno}: {error.msg}" if error.lineno else error.msg  # none where it is no text at all
    file = Path(path).resolve()
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == file]
    at = f"line {lines[-1]}: " if lines else ""
    text = " ".join(str(error).split())
    if isinstance(error, TcbiError):
        return f"{at}{text}"
    missing = MISSING.match(text)
    if missing:
        return f"{at}{missing[1]} lacks {missing[2]}; add it"
    return f"{at}{type(error).__name__}: {text}" if text else f"{at}{type(error).__name__}"
