"""What one browser has chosen: rollouts, a model version, the view, the moment to look at."""

import dataclasses
from collections.abc import Callable

from tcbi_contract.errors import TcbiError
from tcbi_dashboard.workbench import Workbench
from tcbi_infer.bags.glance import Glance
from tcbi_infer.seen import used_before

FIRST_CHOICE = 40  # rollouts chosen at first, the newest ones
RIG = "hexapod"


@dataclasses.dataclass
class Place:
    """A moment of a rollout of the comparison that is shown."""

    rollout: int
    time: float  # s
    signal: str


class Session:
    """One browser's choices."""

    def __init__(self, bench: Workbench) -> None:
        self.bench = bench
        self.model = "latest"
        self.chosen: set[str] | None = None  # paths of bags; None until somebody chooses
        self.place: Place | None = None
        self.seen = ""  # the view that is seen
        self._used: dict[str, set[str]] = {}  # by version, what it was fitted to: a version never changes
        self.go_to: Callable[[str], None] = lambda _: None  # shows another view

    def rollouts(self) -> list[Glance]:
        """What is chosen and still there, the newest first."""
        readable = [e for e in self.bench.catalogue.entries if not e.problem]
        if self.chosen is None:
            return readable[:FIRST_CHOICE]
        return [e for e in readable if str(e.path) in self.chosen]

    def bags(self) -> list[str]:
        """Paths of the rollouts chosen, the oldest first."""
        return [str(e.path) for e in reversed(self.rollouts())]

    def rig(self) -> str:
        """The rig of the rollouts chosen."""
        return next((e.rig for e in self.rollouts() if e.rig), RIG)

    def versions(self) -> list[str]:
        """Versions of that rig's model, oldest first."""
        return self.bench.store.versions(self.rig())

    def seen_by(self) -> dict[str, list[str]]:
        """The versions that were fitted to a rollout, by its id; reads each version once."""
        seen: dict[str, list[str]] = {}
        for version in self.versions():
            if version not in self._used:
                try:
                    self._used[version] = used_before(self.bench.store.load(version))
                except TcbiError:  # what cannot be read has been fitted to nothing that counts
                    continue
            for rollout in self._used[version]:
                seen.setdefault(rollout, []).append(version)
        return seen

    def version(self) -> str:
        """The version chosen; the newest unless one is."""
        known = self.versions()
        return self.model if self.model in known else known[-1] if known else "latest"
