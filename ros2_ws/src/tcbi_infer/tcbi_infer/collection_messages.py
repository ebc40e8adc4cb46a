"""A collection's requests, its rollouts' beginnings and the robot's way as messages and back; needs ROS."""

import math
from typing import Any

from geometry_msgs.msg import Point, PoseStamped, Vector3
from rclpy.serialization import deserialize_message

from tcbi_contract.messages import to_stamp
from tcbi_infer.bags.note import write_note
from tcbi_infer.collection import Request, travelled
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.msg import Block, RolloutEvent
from tcbi_sim.measurement import Scenario


def goal_of(request: Request) -> CollectRollouts.Goal:
    """The action's goal."""
    return CollectRollouts.Goal(
        task=request.task,
        policy=request.policy,
        number=request.number,
        seed=request.seed,
        slope_roll=list(request.slope_roll),
        slope_pitch=list(request.slope_pitch),
        duration_s=request.duration_s,
        model=request.model,
        folder=request.folder,
        distance_timeout_s=request.distance_timeout_s,
    )


def request_of(goal: CollectRollouts.Goal) -> Request:
    """What a goal asks for."""
    return Request(
        task=goal.task,
        number=int(goal.number),
        seed=int(goal.seed),
        policy=goal.policy,
        slope_roll=tuple(goal.slope_roll),
        slope_pitch=tuple(goal.slope_pitch),
        duration_s=float(goal.duration_s),
        model=goal.model,
        folder=goal.folder,
        distance_timeout_s=float(goal.distance_timeout_s),
    )


def begin_event(name: str, scenario: Scenario, policy_id: str, source: str, begin: int) -> RolloutEvent:
    """BEGIN of a rollout at `begin` (ns)."""
    event = RolloutEvent(
        rollout_id=name, kind=RolloutEvent.BEGIN, task=scenario.task, policy_id=policy_id, source=source
    )
    event.header.stamp = to_stamp(begin)
    event.slope_roll, event.slope_pitch = scenario.slope_roll, scenario.slope_pitch
    event.blocks = blocks_of(scenario)
    event.distance = math.nan
    event.note = write_note("hexapod", scenario)
    return event


def blocks_of(scenario: Scenario) -> list[Block]:
    """A scenario's blocks."""
    return [
        Block(
            center=Point(**dict(zip("xyz", b.center, strict=True))),
            size=Vector3(**dict(zip("xyz", b.size, strict=True))),
            yaw=b.yaw,
        )
        for b in scenario.blocks
    ]


def distance_between(first: bytes, last: bytes) -> float:
    """How far (m) the robot has come from one pose of the tracker to another, both as they came."""
    start, end = (deserialize_message(data, PoseStamped).pose for data in (first, last))
    o = start.orientation
    return travelled(_xyz(start.position), _xyz(end.position), (o.x, o.y, o.z, o.w))


def _xyz(point: Any) -> tuple[float, float, float]:
    return (point.x, point.y, point.z)
