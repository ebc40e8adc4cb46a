"""Where the recordings are: a bag's folder, a folder of bags, or a bare .mcap file."""

import contextlib
import fcntl
import re
from collections.abc import Iterable
from pathlib import Path

from tcbi_infer.bags.writer import UNFINISHED
from tcbi_infer.errors import BagError

ASIDE = ".damaged"  # suffix of an original that was repaired and kept
REPAIRED = ".recovered"  # suffix of a hidden, whole bag that is about to take its original's place
SQLITE = (".db3", ".sqlite3")  # of bags of another storage
LOCK = ".recorder.lock"  # held by the recorder that uses a folder


def mcap_files(bag: Path) -> list[Path]:
    """The MCAP files of one bag, `present` under its name or not, in the order in which they were recorded.

    Raises:
      BagError: there is no such path, or nothing in it is MCAP.
    """
    bag = present(bag)
    if bag.is_file():
        if bag.suffix == ".mcap":
            return [bag]
        if bag.name == "metadata.yaml":
            return mcap_files(bag.parent)
        raise BagError(f"{bag}: is no bag, allowed are a bag's folder and an .mcap file; {_instead_of(bag)}")
    if not bag.is_dir():
        raise BagError(f"{bag}: there is no such bag; give a bag's folder or an .mcap file")
    files = sorted(bag.glob("*.mcap"), key=_natural)
    if not files:
        raise BagError(f"{bag}: {_what_instead(bag)}")
    return files


def present(bag: Path) -> Path:
    """The bag of this name, or the unfinished one that a recorder left when it was killed."""
    if bag.exists():
        return bag
    finish_repairs(bag.parent)
    unfinished = bag.with_name(f"{bag.name}{UNFINISHED}")
    return unfinished if not bag.exists() and unfinished.is_dir() else bag


def finish_repairs(folder: Path) -> list[Path]:
    """Give repaired bags their names where the repair was killed after it had put the original aside; returns them."""
    finished = []
    for repaired in folder.glob(f".*{REPAIRED}"):
        bag = folder / repaired.name[1:].removesuffix(REPAIRED)
        if not bag.exists() and _kept_as(bag, repaired.is_dir()).exists():
            with contextlib.suppress(OSError):  # another process was faster, or the folder cannot be written
                finished.append(repaired.rename(bag))
    return finished


def find_bags(paths: Iterable[Path]) -> list[Path]:
    """The bags among `paths`; a folder that is no bag itself stands for the bags in it, in order of name.

    What `left_out` names is not among them.

    Raises:
      BagError: a path holds no bag.
    """
    paths = list(map(present, paths))
    skipped = left_out(paths)
    found: list[Path] = []
    for path in (p for p in paths if p not in skipped):
        if path.is_dir() and not is_bag(path):
            inside = bags_in(path)
            if not inside:
                raise BagError(f"{path}: {_what_instead(path)}")
            found += inside
        elif path.name == "metadata.yaml" and path.is_file():
            found.append(path.parent)
        else:
            mcap_files(path)
            found.append(path)
    return list(dict.fromkeys(found))


def bags_in(folder: Path) -> list[Path]:
    """The bags right in a folder, in order of name; no hidden one (a repair at work), and none for `left_out`.

    Repairs that were killed at their last step are finished first, so that no rollout is missing.
    """
    finish_repairs(folder)
    paths = (p for p in folder.iterdir() if not p.name.startswith("."))
    return [p for p in sorted(paths, key=_natural) if is_bag(p) and not _unwanted(p)]


def left_out(paths: Iterable[Path]) -> dict[Path, str]:
    """Which of several paths, as a shell's `rollouts/*` names them, are no rollouts of their own, each with the reason.

    None where all are like that: who names a damaged original alone wants it.
    """
    paths = dict.fromkeys(paths)
    reasons = {path: why for path in paths if (why := _unwanted(path))}
    return reasons if len(reasons) < len(paths) else {}


def is_bag(path: Path) -> bool:
    """Whether this is a bag's folder or a bare MCAP file; a folder in which bags lie beside a bare file is none."""
    if not path.is_dir():
        return path.suffix == ".mcap" and path.is_file()
    return any(path.glob("*.mcap")) and ((path / "metadata.yaml").is_file() or not any(path.glob("*/*.mcap")))


def is_recording(folder: Path) -> bool:
    """Whether a recorder uses this folder now, so that an unfinished bag in it is still being written."""
    lock = folder / LOCK
    if not lock.is_file():
        return False
    with lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def _kept_as(bag: Path, is_folder: bool) -> Path:
    """Where a repair keeps the original of a bag's folder or of a bare file."""
    return bag.with_name(f"{bag.name}{ASIDE}" if is_folder else f"{bag.stem}{ASIDE}{bag.suffix}")


def set_aside(path: Path) -> bool:
    """Whether this is an original that a repair kept."""
    return ASIDE in path.suffixes


def _unwanted(path: Path) -> str:
    """Why a bag, or a file in it, is no rollout of its own; empty for any other."""
    for bag in (path, path.parent) if path.is_file() else (path,):
        if set_aside(bag):
            return "it is the damaged original that a repair kept"
        if bag.suffix == UNFINISHED and is_recording(bag.parent):
            return "it is being recorded right now"
    return ""


def bag_name(bag: Path) -> str:
    """A bag's name without what marks it as unfinished or as a file."""
    name = bag.name
    for suffix in (".mcap", UNFINISHED):
        name = name.removesuffix(suffix)
    return name


def _natural(path: Path) -> list:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _what_instead(folder: Path) -> str:
    database = next(folder.rglob("*.db3"), None)
    if database:
        return f"holds no .mcap file; {_convert(database.parent)}"
    packed = next(folder.rglob("*.mcap.zstd"), None)
    if packed:
        return _unpack(packed)
    return "holds no bag (no .mcap file); give a bag's folder or an .mcap file"


def _instead_of(file: Path) -> str:
    if file.suffix in SQLITE:
        return _convert(file)
    if file.name.endswith(".mcap.zstd"):
        return _unpack(file)
    return "give one of these, or turn a log into a bag with ./tcbi import"


def _unpack(file: Path) -> str:
    return f"{file.name} is compressed as a whole; unpack it with: unzstd {file.name} -o {file.stem}"


def _convert(path: Path) -> str:
    return f"convert an SQLite bag with: rosbags-convert --src {path} --dst {bag_name(path)}_mcap --dst-storage mcap"
