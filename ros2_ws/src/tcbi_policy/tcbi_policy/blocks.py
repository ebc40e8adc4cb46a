"""Which rollouts went over a block: seen from above, the middle of the trunk or a foot was within its edges.

A block is solid, so a foot within its edges is above it; one that only pushes against its side stays outside. A trunk
over a block that no foot was over has taken it between its legs.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_policy.kinematics import forward
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Block, Scenario, quaternion_from_rpy
from tcbi_sim.rigs.hexapod import hexapod_rig
from tcbi_sim.sensing import rotate_back


@dataclass(frozen=True)
class OverBlocks:
    """What of the robot came over a block in each of n rollouts."""

    trunk: np.ndarray  # (n,) bool, its middle
    foot: np.ndarray  # (n,) bool, one of its feet; False where it is unknown where they are


def over_blocks(rollouts: SimulatedRollouts) -> OverBlocks:
    """What came over a block in paired rollouts; the feet are those of the built-in hexapod, others' are not known."""
    assert rollouts.attitude is not None and rollouts.position is not None
    legs = rollouts.rig.name == hexapod_rig().name
    found = OverBlocks(*(np.zeros(len(rollouts.scenarios), bool) for _ in range(2)))
    for n, scenario in enumerate(rollouts.scenarios):
        if scenario.blocks:
            rows = n, 0, slice(np.searchsorted(rollouts.time, scenario.duration + 1e-9))
            trunk = rollouts.position[rows]
            found.trunk[n] = came_over(trunk, scenario)
            if legs:
                points = feet(trunk, rollouts.attitude[rows], rollouts.joint_position[rows])
                found.foot[n] = came_over(points, scenario)
    return found


def feet(position: np.ndarray, attitude: np.ndarray, joint_position: np.ndarray) -> np.ndarray:
    """The hexapod's feet (T, 6, 3) in m in the world.

    Args:
      position: (T, 3) m, of the trunk.
      attitude: (T, 4) w x y z, of the trunk in the world.
      joint_position: (T, 18) rad.
    """
    to_world = attitude[:, None] * [1.0, -1.0, -1.0, -1.0]
    return position[:, None] + rotate_back(to_world, forward(joint_position))


def came_over(points: np.ndarray, scenario: Scenario) -> bool:
    """Whether one of the points (..., 3), m in the world, is within the edges of one of the scenario's blocks."""
    ground = quaternion_from_rpy(np.array(scenario.slope_roll), np.array(scenario.slope_pitch), np.array(0.0))
    on_plane = rotate_back(np.broadcast_to(ground, (*points.shape[:-1], 4)), points)
    return any(_within(on_plane, block).any() for block in scenario.blocks)


def _within(points: np.ndarray, block: Block) -> np.ndarray:
    """Whether each point (..., 3), m in the ground's frame, is within the block's edges, seen from above."""
    x, y = np.moveaxis(points[..., :2] - np.array(block.center[:2]), -1, 0)
    cosine, sine = np.cos(block.yaw), np.sin(block.yaw)
    along, across = cosine * x + sine * y, cosine * y - sine * x
    return (np.abs(along) <= block.size[0] / 2) & (np.abs(across) <= block.size[1] / 2)
