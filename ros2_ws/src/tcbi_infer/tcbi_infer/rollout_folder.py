"""Finished bags of a folder as they appear, and which of them are kept out of every fit."""

import contextlib
import time
from pathlib import Path

from tcbi_infer.bags.files import bag_name, bags_in
from tcbi_infer.bags.writer import UNFINISHED

QUIET_S = 10.0  # without a change, until a bag that has no metadata counts as finished


class RolloutFolder:
    """Bags in order of arrival; every `holdout_every`-th is only ever judged on."""

    def __init__(self, path: Path, holdout_every: int):
        self.path, self.holdout_every = path, holdout_every
        self.bags: list[Path] = []

    def look(self) -> int:
        """Take note of bags that were finished since; returns how many."""
        fresh: list[tuple[float, str, Path]] = []
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):  # no folder yet, or no more
            for bag in bags_in(self.path):
                with contextlib.suppress(FileNotFoundError):  # renamed or removed meanwhile
                    if bag not in self.bags and bag.suffix != UNFINISHED and _finished(bag):
                        fresh.append((bag.stat().st_mtime, bag_name(bag), bag))
        self.bags += [bag for _, _, bag in sorted(fresh)]
        return len(fresh)

    @property
    def held_out(self) -> list[Path]:
        """For judging."""
        return [] if self.holdout_every == 0 else self.bags[self.holdout_every - 1 :: self.holdout_every]

    @property
    def fitted(self) -> list[Path]:
        """For fitting."""
        apart = set(self.held_out)
        return [bag for bag in self.bags if bag not in apart]


def _finished(bag: Path) -> bool:
    """Whether a bag has its metadata, or, as after a full disk, none and nobody writes to it."""
    if (bag / "metadata.yaml").is_file():
        return True
    changed = max(path.stat().st_mtime for path in (bag, *bag.glob("*")))
    return time.time() - changed > QUIET_S
