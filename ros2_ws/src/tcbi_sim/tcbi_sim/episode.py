"""From what somebody asks of the sim node to a scenario, with everything wrong said at once."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_contract.names import JOINT_LIMIT, JOINTS, SLOPE_LIMIT
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Block, Scenario
from tcbi_sim.tasks import find_task, tasks
from tcbi_sim.user_tasks import LONGEST_S, MOST_BLOCKS


class EpisodeError(SimError):
    """A reset asks for something that the simulator cannot set."""


def first_scenario(task: str, seed: int) -> Scenario:
    """What stands there before the first reset: a drawn scenario of a task, or flat ground for an empty name.

    Raises:
      UnknownNameError: there is no such task.
    """
    if not task:
        return Scenario("", math.inf, seed=seed)
    return find_task(task).draw(np.random.default_rng(seed), seed)


def requested_scenario(request: Any) -> Scenario:
    """The scenario of a `ResetEpisode` request.

    Raises:
      EpisodeError: all faults at once.
    """
    faults = []
    if request.task and request.task not in tasks():
        faults.append(f"task: got {request.task!r}, allowed is one of {', '.join(tasks())}, or empty for none")
    slopes = {"slope_roll": request.slope_roll, "slope_pitch": request.slope_pitch}
    outside = [(n, v) for n, v in slopes.items() if not abs(v) <= SLOPE_LIMIT + 1e-9]
    faults += [f"{name}: got {value}, allowed is -pi/6 to pi/6 rad" for name, value in outside]
    if not math.isfinite(request.yaw):
        faults.append(f"yaw: got {request.yaw}, allowed is a finite angle, rad")
    if not 0 <= request.duration <= LONGEST_S:
        faults.append(f"duration: got {request.duration}, allowed is 0 s (the task's own) to {LONGEST_S:.0f} s")
    faults += _posture_faults(request.joint_position) + _block_faults(request.blocks)
    if faults:
        raise EpisodeError("reset: " + "; ".join(faults))
    own = find_task(request.task).duration if request.task else math.inf
    return Scenario(
        request.task,
        request.duration or own,
        request.slope_roll,
        request.slope_pitch,
        tuple(block_of(b) for b in request.blocks),
        tuple(float(x) for x in request.joint_position) or None,
        initial_yaw=request.yaw,
        seed=int(request.seed),
    )


def _posture_faults(position: Sequence[float]) -> list[str]:
    if len(position) not in (0, len(JOINTS)):
        return [
            f"joint_position: got {len(position)} values, allowed are {len(JOINTS)}, or none for the neutral stance"
        ]
    wrong = [f"{n}={x}" for n, x in zip(JOINTS, position, strict=False) if not abs(x) <= JOINT_LIMIT + 1e-9]
    return [f"joint_position: got {', '.join(wrong)}, allowed is -pi/6 to pi/6 rad"] if wrong else []


def _block_faults(blocks: Sequence[Any]) -> list[str]:
    if len(blocks) > MOST_BLOCKS:
        return [f"blocks: got {len(blocks)}, allowed are {MOST_BLOCKS}"]
    faults = []
    for i, block in enumerate(block_of(b) for b in blocks):
        if not all(math.isfinite(v) for v in (*block.center, block.yaw)):
            faults.append(f"blocks[{i}]: got centre {block.center} and yaw {block.yaw}, allowed are finite numbers")
        if not all(0 < v <= 10 for v in block.size):
            faults.append(f"blocks[{i}].size: got {block.size}, allowed is more than 0 and up to 10 m")
    return faults


def block_of(message: Any) -> Block:
    """A block as a message of tcbi_msgs has it."""
    c, s = message.center, message.size
    return Block((c.x, c.y, c.z), (s.x, s.y, s.z), message.yaw)
