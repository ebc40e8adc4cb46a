"""Finished bags of a folder as they appear, which of them belong together, and which are kept out of every fit."""

import contextlib
import time
from collections.abc import Collection, Hashable
from pathlib import Path

from tcbi_infer.bags.files import bag_name, bags_in
from tcbi_infer.bags.glance import Glance, glance
from tcbi_infer.bags.writer import UNFINISHED
from tcbi_infer.compare.replicates import SCRIPTED

SLOPE_DIGITS = 4  # of a slope in rad: what the robot was told, the same for each repeat
QUIET_S = 10.0  # without a change, until a bag that has no metadata counts as finished


class RolloutFolder:
    """Bags in order of arrival, those of the newest's source alone; every `holdout_every`-th is only ever judged on.

    What a simulation did yesterday says nothing of the robot that moves today. Repeats of a scripted motion stay
    together: one that is held out while another is fitted would tell nothing new.
    """

    def __init__(self, path: Path, holdout_every: int):
        self.path, self.holdout_every = path, holdout_every
        self._seen: dict[Path, Glance] = {}  # of every source, in order of arrival

    def look(self) -> int:
        """Take note of bags that were finished since; returns how many."""
        fresh: list[tuple[float, str, Path]] = []
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):  # no folder yet, or no more
            for bag in bags_in(self.path):
                with contextlib.suppress(FileNotFoundError):  # renamed or removed meanwhile
                    if bag not in self._seen and bag.suffix != UNFINISHED and _finished(bag):
                        fresh.append((bag.stat().st_mtime, bag_name(bag), bag))
        self._seen |= {bag: glance(bag) for _, _, bag in sorted(fresh)}
        return len(fresh)

    @property
    def source(self) -> str:
        """Of the newest bag that can be read: `driver`, `sim`, or free text; empty where it names none."""
        return next((seen.source for seen in reversed(self._seen.values()) if not seen.problem), "")

    @property
    def rig(self) -> str:
        """Of the newest bag that can be read; empty where it names none."""
        return next((seen.rig for seen in reversed(self._seen.values()) if not seen.problem), "")

    @property
    def bags(self) -> list[Path]:
        """Those of this source, and those that cannot be read: whoever reads them says why."""
        source = self.source
        return [bag for bag, seen in self._seen.items() if seen.problem or seen.source == source]

    @property
    def left_out(self) -> dict[Path, str]:
        """The others, each with its source."""
        used = set(self.bags)
        return {bag: seen.source for bag, seen in self._seen.items() if bag not in used}

    @property
    def held_out(self) -> list[Path]:
        """For judging."""
        if self.holdout_every == 0:
            return []
        numbers: dict[Hashable, int] = {}  # of motions, from 1 on
        for bag in self.bags:
            numbers.setdefault(_motion(self._seen[bag]), len(numbers) + 1)
        return [bag for bag in self.bags if numbers[_motion(self._seen[bag])] % self.holdout_every == 0]

    @property
    def fitted(self) -> list[Path]:
        """For fitting."""
        apart = set(self.held_out)
        return [bag for bag in self.bags if bag not in apart]

    def holding(self, rollouts: Collection[str]) -> set[Path]:
        """The bags whose rollout, in a bag of several the first, is one of these."""
        return {bag for bag, seen in self._seen.items() if seen.rollout_id in rollouts}


def _motion(seen: Glance) -> Hashable:
    """What repeats of a rollout have in common; a policy with feedback never moves the same way again."""
    if not seen.policy_id.startswith(SCRIPTED):
        return seen.path
    return seen.task, seen.policy_id, round(seen.slope_roll, SLOPE_DIGITS), round(seen.slope_pitch, SLOPE_DIGITS)


def _finished(bag: Path) -> bool:
    """Whether a bag has its metadata, or, as after a full disk, none and nobody writes to it."""
    if (bag / "metadata.yaml").is_file():
        return True
    changed = max(path.stat().st_mtime for path in (bag, *bag.glob("*")))
    return time.time() - changed > QUIET_S
