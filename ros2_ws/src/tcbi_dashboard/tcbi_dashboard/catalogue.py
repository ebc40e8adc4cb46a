"""The rollouts that the page offers: cheap with hundreds of bags, since each is read once, and only its beginning."""

import threading
from collections.abc import Iterable, Sequence
from pathlib import Path

from tcbi_infer.bags.files import find_bags, is_bag
from tcbi_infer.bags.glance import Glance, glance
from tcbi_infer.bags.writer import UNFINISHED
from tcbi_infer.errors import BagError

Stamp = tuple[int, int]


class Catalogue:
    """Bags of some folders and of the folders in them, newest first; safe to ask from several threads."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders = tuple(folders)
        self.added: tuple[Path, ...] = ()  # folders of what was recorded from the page, besides its own
        self.revision = 0  # grows when something has come or gone
        self._known: dict[Path, tuple[Stamp, Glance]] = {}
        self._lock = threading.Lock()

    @property
    def entries(self) -> list[Glance]:
        """What `look` found last."""
        found = [entry for _, entry in self._known.values()]
        return sorted(found, key=lambda e: (e.started or 0.0, e.rollout_id), reverse=True)

    def look(self) -> bool:
        """Look at what is new or changed; returns whether anything is."""
        with self._lock:
            known: dict[Path, tuple[Stamp, Glance]] = {}
            for bag in self._bags():
                stamp = _stamp(bag)
                before = self._known.get(bag)
                known[bag] = before if before and before[0] == stamp else (stamp, glance(bag))
            changed = known != self._known
            self._known = known
            self.revision += changed
            return changed

    def include(self, bags: Iterable[Path]) -> None:
        """Offer the folders of these bags too, from now on."""
        for folder in dict.fromkeys(bag.parent for bag in bags if bag.exists()):
            own = {place.resolve() for place in (*self.folders, *self.added)}
            if not own & {folder.resolve(), folder.resolve().parent}:
                self.added = (*self.added, folder)

    def _bags(self) -> list[Path]:
        found: list[Path] = []
        for folder in (*self.folders, *self.added):
            inside = [p for p in folder.iterdir() if p.is_dir() and not is_bag(p)] if folder.is_dir() else []
            for place in (folder, *sorted(inside)):
                try:
                    found += find_bags([place])
                except BagError:  # none in there yet
                    continue
        return [bag for bag in dict.fromkeys(found) if bag.suffix != UNFINISHED]


def _stamp(bag: Path) -> Stamp:
    """Changes when a bag does."""
    file = bag / "metadata.yaml" if (bag / "metadata.yaml").is_file() else bag
    status = file.stat()
    return status.st_mtime_ns, status.st_size
