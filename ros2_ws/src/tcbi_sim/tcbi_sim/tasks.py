"""What a robot is asked to do: terrain, initial state, and how long. Episodes never end early (paper, section 3)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tcbi_contract.names import JOINTS
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.measurement import Block, Scenario

BLOCK_HEIGHT = (0.06, 0.08)  # m (paper, Table 1)
BLOCK_LENGTH = (0.10, 0.20)  # m (paper, Table 1)
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


def draw_balance(rng: np.random.Generator, seed: int = 0) -> Scenario:
    """A tilted plane without blocks; tilt uniform up to `TILT` in any direction, the posture random."""
    tilt, direction = rng.uniform(0, TILT), rng.uniform(-math.pi, math.pi)
    roll, pitch = tilt * math.cos(direction), tilt * math.sin(direction)
    return Scenario("balance", 8.0, float(roll), float(pitch), (), _posture(rng), seed=seed)


def draw_forward(rng: np.random.Generator, seed: int = 0) -> Scenario:
    """Level ground with up to eight blocks ahead of the robot and beside it."""
    blocks = []
    for _ in range(int(rng.integers(4, 9))):
        height = rng.uniform(*BLOCK_HEIGHT)
        size = (rng.uniform(*BLOCK_LENGTH), rng.uniform(*BLOCK_LENGTH), height)
        center = (rng.uniform(0.45, 2.0), rng.uniform(-0.6, 0.6), height / 2)
        blocks.append(Block(center, size, rng.uniform(-math.pi, math.pi)))
    return Scenario("forward", 30.0, 0.0, 0.0, tuple(blocks), _posture(rng), seed=seed)


def _posture(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(x) for x in rng.uniform(-INITIAL_JOINT, INITIAL_JOINT, len(JOINTS)))


TASKS = {
    "balance": Task("balance", 8.0, "level the trunk on a tilted plane", 0, draw_balance),
    "forward": Task("forward", 30.0, "walk forward over blocks", 8, draw_forward),
}


def find_task(name: str) -> Task:
    """The task of this name.

    Raises:
      UnknownNameError: there is none.
    """
    if name not in TASKS:
        raise UnknownNameError("task", name, tuple(TASKS))
    return TASKS[name]
