"""A job of the page in one line of JSON; the process that does it is `work`."""

import dataclasses
import json
from typing import Any

COMPARE, DIAGNOSE, HISTORY = "compare", "diagnose", "history"
ADD, REMOVE, INFER, RETRAIN, COLLECT = "add", "remove", "infer", "retrain", "collect"
MODULE = "tcbi_dashboard.work"


@dataclasses.dataclass(frozen=True)
class Task:
    """What a worker is asked for."""

    kind: str
    store: str
    model: str = "latest"
    bags: tuple[str, ...] = ()
    options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def to_json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> "Task":
        """The task of a line."""
        data = json.loads(text)
        return Task(**{**data, "bags": tuple(data["bags"])})
