"""The rollouts that a goal of `collect_rollouts` asks for: its check, and the scenario of each. Knows no ROS."""

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S, SLOPE_LIMIT
from tcbi_contract.wording import counted
from tcbi_infer.bags.tracker import heading
from tcbi_infer.errors import RequestError
from tcbi_sim.measurement import Scenario
from tcbi_sim.tasks import find_task, tasks

PERIOD_NS = round(CONTROL_PERIOD_S * 1e9)
MOST_ROLLOUTS = 10_000
LONGEST_S = 3600.0


@dataclass(frozen=True)
class Request:
    """A goal in plain types; see `CollectRollouts.action`."""

    task: str
    number: int
    seed: int = 0
    policy: str = ""  # empty: the one that is loaded; "none": no policy takes part
    slope_roll: tuple[float, ...] = ()  # rad
    slope_pitch: tuple[float, ...] = ()  # rad
    duration_s: float = 0.0
    model: str = ""
    folder: str = ""
    distance_timeout_s: float = 0.0  # 0: the recorder's own


def check(request: Request) -> None:
    """Raise RequestError that names everything wrong with a request."""
    faults = []
    if request.task not in tasks():
        faults.append(f"task: got {request.task!r}, allowed is one of {', '.join(tasks())}")
    if not 1 <= request.number <= MOST_ROLLOUTS:
        faults.append(f"number: got {request.number}, allowed is 1 to {MOST_ROLLOUTS}")
    if not (request.duration_s == 0 or 0.2 <= request.duration_s <= LONGEST_S):
        faults.append(
            f"duration_s: got {request.duration_s}, allowed is 0 (the task's own) or 0.2 to {LONGEST_S:.0f} s"
        )
    if not request.distance_timeout_s >= 0:
        faults.append(f"distance_timeout_s: got {request.distance_timeout_s}, allowed is 0 or more, s")
    for name, slopes in (("slope_roll", request.slope_roll), ("slope_pitch", request.slope_pitch)):
        faults += _slope_faults(name, slopes, request.number)
    if faults:
        raise RequestError("collect_rollouts: " + "; ".join(faults))


def _slope_faults(name: str, slopes: Sequence[float], number: int) -> list[str]:
    if slopes and len(slopes) != number:
        return [f"{name}: got {len(slopes)} values, allowed are {number} (one a rollout), or none to draw them"]
    outside = [s for s in slopes if not abs(s) <= SLOPE_LIMIT + 1e-9]
    return [f"{name}: got {outside[0]}, allowed is -pi/6 to pi/6 rad"] if outside else []


def scenario_of(request: Request, index: int) -> Scenario:
    """The scenario of rollout `index`: the same for the same seed, on any machine, whatever else is asked."""
    task = find_task(request.task)
    sequence = np.random.SeedSequence([request.seed, index])
    seed = int(sequence.generate_state(1)[0])
    scenario = task.draw(np.random.default_rng(sequence), seed)
    changes: dict[str, float] = {}
    if request.slope_roll:
        changes["slope_roll"] = float(request.slope_roll[index])
    if request.slope_pitch:
        changes["slope_pitch"] = float(request.slope_pitch[index])
    if request.duration_s:
        changes["duration"] = float(request.duration_s)
    return dataclasses.replace(scenario, **changes)  # type: ignore[arg-type]


def as_it_is(request: Request, scenario: Scenario) -> Scenario:
    """The scenario on ground that nobody has set: what was drawn is not there, a slope that was given is."""
    return dataclasses.replace(
        scenario,
        slope_roll=scenario.slope_roll if request.slope_roll else 0.0,
        slope_pitch=scenario.slope_pitch if request.slope_pitch else 0.0,
        blocks=(),
    )


def rollout_id(request: Request, index: int, now: float | None = None) -> str:
    """A name that sorts by time (UTC, to the millisecond): `balance-20261121-004512-391-s1-003`."""
    second, fraction = divmod(time.time() if now is None else now, 1.0)
    day = time.strftime("%Y%m%d-%H%M%S", time.gmtime(second))
    return f"{request.task}-{day}-{int(1000 * fraction):03d}-s{request.seed}-{index:03d}"


def recorded(number: int) -> str:
    """What a collection answers where there is nothing more to say."""
    return f"{counted(number, 'rollout')} recorded"


def next_tick(nanoseconds: int) -> int:
    """The next multiple of the control period: the policy's ticks lie there."""
    return -(-nanoseconds // PERIOD_NS) * PERIOD_NS


def travelled(start: Sequence[float], end: Sequence[float], orientation: Sequence[float]) -> float:
    """Metres from start to end along the direction the robot faced at the start.

    Args:
      start, end: positions in the world, m.
      orientation: x y z w at the start; where it is no unit quaternion, the robot faced the world's x axis.
    """
    yaw = heading(orientation) or 0.0
    return (end[0] - start[0]) * math.cos(yaw) + (end[1] - start[1]) * math.sin(yaw)
