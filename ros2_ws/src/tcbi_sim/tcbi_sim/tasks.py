"""What a robot is asked to do: terrain, initial state, and how long. Episodes never end early (paper, section 3).

The user's own tasks lie in the folder that TCBI_TASKS names, else in `tasks` of the store, one file each (see
user_tasks.py and docs/policies.md). One that cannot be used is left out with a line in the log.
"""

import contextlib
import functools
import logging
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.names import JOINTS
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.measurement import Block, Scenario
from tcbi_sim.places import default_root
from tcbi_sim.user_file import included, python_files

log = logging.getLogger(__name__)
USER_TASKS = "TCBI_TASKS"  # environment variable: the folder with the user's own tasks

BLOCK_HEIGHT = (0.06, 0.08)  # m (paper, Table 1)
BLOCK_LENGTH = (0.10, 0.20)  # m (paper, Table 1)
BLOCK_COUNT = (30, 48)  # one in 0.46 m^2 of the field: the paper places them anywhere
FIELD_AHEAD = (0.45, 8.0)  # m ahead of the start; the best walks come past it in an episode
FIELD_ASIDE = 1.2  # m to either side: who walks straight stays within
TILT = math.pi / 9  # rad: within Table 1's +-pi/6, and less than the 27 degrees at which the lowest friction gives way
INITIAL_JOINT = math.pi / 18  # rad, spread of the initial posture about the neutral stance


@dataclass(frozen=True)
class Task:
    """A task, and how its scenarios are drawn."""

    name: str
    duration: float  # s
    description: str
    blocks: int  # at most
    draw: Callable[[np.random.Generator, int], Scenario]
    reward: tuple[Any, ...] = ()  # terms, for a user's own task; those of the built-in ones stand in tcbi_policy.reward


def draw_balance(rng: np.random.Generator, seed: int = 0) -> Scenario:
    """A tilted plane without blocks; tilt uniform up to `TILT` in any direction, the posture random."""
    tilt, direction = rng.uniform(0, TILT), rng.uniform(-math.pi, math.pi)
    roll, pitch = tilt * math.cos(direction), tilt * math.sin(direction)
    return Scenario("balance", 8.0, float(roll), float(pitch), (), _posture(rng), seed=seed)


def draw_forward(rng: np.random.Generator, seed: int = 0) -> Scenario:
    """Level ground with blocks all along the way, ahead of the robot and beside it."""
    count = int(rng.integers(BLOCK_COUNT[0], BLOCK_COUNT[1] + 1))
    low, high = np.array([
        BLOCK_HEIGHT, BLOCK_LENGTH, BLOCK_LENGTH, FIELD_AHEAD, (-FIELD_ASIDE, FIELD_ASIDE), (-math.pi, math.pi),
    ]).T  # fmt: skip
    drawn = rng.uniform(low, high, (count, len(low))).tolist()
    blocks = [Block((x, y, height / 2), (long, wide, height), yaw) for height, long, wide, x, y, yaw in drawn]
    return Scenario("forward", 30.0, 0.0, 0.0, tuple(blocks), _posture(rng), seed=seed)


def _posture(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(x) for x in rng.uniform(-INITIAL_JOINT, INITIAL_JOINT, len(JOINTS)))


TASKS = {
    "balance": Task("balance", 8.0, "level the trunk on a tilted plane", 0, draw_balance),
    "forward": Task("forward", 30.0, "walk forward over blocks", BLOCK_COUNT[1], draw_forward),
}


def tasks_folder() -> Path:
    """The folder with the user's own tasks: TCBI_TASKS, else `tasks` in the store."""
    given = os.environ.get(USER_TASKS)
    return Path(given).expanduser() if given else default_root().expanduser() / "tasks"


def tasks() -> dict[str, Task]:
    """All tasks by name: the built-in ones, then the user's own, without those that cannot be used."""
    return _tasks_of(tasks_folder())


@functools.cache
def _tasks_of(folder: Path) -> dict[str, Task]:
    from tcbi_sim.user_tasks import UserTaskError, load_file

    found, by = dict(TASKS), dict.fromkeys(TASKS, "a built-in task")
    for path in python_files(folder):
        try:
            task = load_file(path)
            if task.name in found:
                taken = f"the name {task.name!r} is taken already, by {by[task.name]}; choose another one"
                raise UserTaskError(path, [taken])
        except UserTaskError as e:
            log.warning("%s; it is left out, ./tcbi tasks check tells more", e)
            continue
        found[task.name], by[task.name] = task, path.name
    return found


@contextlib.contextmanager
def including(task: Task) -> Iterator[None]:
    """The tasks with one more for a while, which hides one of the same name."""
    with included(tasks(), task.name, task):
        yield


class Drawn(NamedTuple):
    """One quantity of a task's scenarios, over many draws."""

    what: str
    unit: str
    low: float
    median: float
    high: float


def drawn(task: Task, count: int = 400) -> list[Drawn]:
    """What a task's scenarios are like: least, median and most of `count` draws, without what is always 0.

    Args:
      task: whose scenarios are drawn, by the same seeds each time.
      count: of them.
    """
    rng = np.random.default_rng(0)
    scenarios = [task.draw(rng, seed) for seed in range(count)]
    blocks = np.array([(*b.size, *b.center[:2]) for s in scenarios for b in s.blocks])
    slopes = [math.acos(math.cos(s.slope_roll) * math.cos(s.slope_pitch)) for s in scenarios]
    values: list[tuple[str, str, Any]] = [
        ("duration", "s", [s.duration for s in scenarios]),
        ("slope of the ground", "deg", np.degrees(slopes)),
        ("heading at the start", "deg", np.degrees([s.initial_yaw for s in scenarios])),
        ("joints at the start", "deg", np.degrees([q for s in scenarios for q in s.initial_joint_position or (0.0,)])),
        ("blocks", "1", [len(s.blocks) for s in scenarios]),
    ]
    for i, (what, unit) in enumerate(
        (("length of a block", "m"), ("width of a block", "m"), ("height of a block", "m"),
         ("a block ahead of the start", "m"), ("a block to the left of it", "m"))
    ):  # fmt: skip
        values += [(what, unit, blocks[:, i])] if len(blocks) else []
    return [Drawn(what, unit, *np.quantile(v, [0.0, 0.5, 1.0]).tolist()) for what, unit, v in values if np.any(v)]


def find_task(name: str) -> Task:
    """The task of this name.

    Raises:
      UnknownNameError: there is none.
    """
    known = tasks()
    if name not in known:
        raise UnknownNameError("task", name, tuple(known))
    return known[name]
