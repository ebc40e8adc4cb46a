"""A user's own task, one file: read without trusting it, and every fault in one plain line.

task = load_file(path)       # raises UserTaskError, whose `faults` are lines
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_sim.tasks import Task
from tcbi_sim.user_file import NAME, UserFileError, read_one

LONGEST_S = 3600.0
MOST_BLOCKS = 64
WORDS = {
    "name": "a text",
    "weight": "a number",
    "unit": "a text",
    "formula": "a text",
    "measure": "a function of Steps",
}


class UserTaskError(UserFileError):
    """A user's file that holds no usable task."""

    holds = "task"


def load_file(path: Path) -> Task:
    """The TASK of a file.

    Raises:
      UserTaskError: the file cannot be imported, or what it defines cannot be used.
    """
    task = read_one(path, "TASK", Task, UserTaskError)
    faults = unusable(task)
    if faults:
        raise UserTaskError(path, faults)
    return task


def unusable(task: Task) -> list[str]:
    """What would break a training, a rollout or an inference of this task."""
    faults = []
    if not isinstance(task.name, str) or not NAME.fullmatch(task.name):
        faults.append(f"name is {task.name!r}, allowed are small letters, digits and _, such as 'my_task'")
    if not isinstance(task.duration, (int, float)) or not CONTROL_PERIOD_S <= task.duration <= LONGEST_S:
        faults.append(f"duration is {task.duration!r}, allowed are {CONTROL_PERIOD_S} to {LONGEST_S:.0f} s")
    elif not math.isclose(task.duration / CONTROL_PERIOD_S, round(task.duration / CONTROL_PERIOD_S)):
        faults.append(
            f"duration is {task.duration} s, allowed are multiples of the control period, {CONTROL_PERIOD_S} s"
        )
    if not isinstance(task.blocks, int) or not 0 <= task.blocks <= MOST_BLOCKS:
        faults.append(f"blocks is {task.blocks!r}, allowed is the most that draw() places, 0 to {MOST_BLOCKS}")
    if not callable(task.draw):
        faults.append(f"draw is {task.draw!r}, allowed is a function of a Generator and a seed that returns a Scenario")
    if not isinstance(task.reward, tuple) or not task.reward:
        faults.append(
            "reward must be a tuple of Term of tcbi_policy.reward; write (Term(…),) with the comma even for one"
        )
    else:
        faults += [fault for i, term in enumerate(task.reward) for fault in _term_faults(i, term)]
    return faults


def _term_faults(number: int, term: Any) -> list[str]:
    """What is not as a Term of tcbi_policy.reward, which this package cannot name."""
    kinds: dict[str, Any] = {"name": str, "weight": (int, float), "unit": str, "formula": str, "measure": Callable}
    lacks = [name for name in kinds if not hasattr(term, name)]
    if lacks:
        return [f"reward[{number}] is a {type(term).__name__}, allowed is a Term of tcbi_policy.reward"]
    return [
        f"reward[{number}].{name} is {getattr(term, name)!r}, allowed is {WORDS.get(name, 'a text')}"
        for name, kind in kinds.items()
        if not isinstance(getattr(term, name), kind)
    ]
