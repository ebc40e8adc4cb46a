"""Finished bags of a folder as they appear, and which of them are kept out of every fit."""

from pathlib import Path

from tcbi_infer.bags.files import bag_name, find_bags
from tcbi_infer.bags.writer import UNFINISHED
from tcbi_infer.errors import BagError


class RolloutFolder:
    """Bags in order of arrival; every `holdout_every`-th is only ever judged on."""

    def __init__(self, path: Path, holdout_every: int):
        self.path, self.holdout_every = path, holdout_every
        self.bags: list[Path] = []

    def look(self) -> int:
        """Take note of bags that were finished since; returns how many."""
        if not self.path.is_dir():
            return 0
        try:
            found = find_bags([self.path])
        except BagError:  # none yet
            return 0
        fresh = [bag for bag in found if bag not in self.bags and bag.suffix != UNFINISHED]
        fresh = [bag for bag in fresh if bag.is_file() or (bag / "metadata.yaml").is_file()]
        fresh.sort(key=lambda bag: (bag.stat().st_mtime, bag_name(bag)))
        self.bags += fresh
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
