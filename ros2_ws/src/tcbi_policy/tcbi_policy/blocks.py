"""Which rollouts went over a block: seen from above, the middle of the trunk or a foot was within its edges.

And which left all blocks behind, and when: whoever did so walks on bare ground from then on.

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
    feet: np.ndarray  # (n,) how many blocks one of its feet came over; 0 where it is unknown where they are
    past_s: np.ndarray  # (n,) s until its middle was past the last block along the heading at the start; NaN if never


def over_blocks(rollouts: SimulatedRollouts) -> OverBlocks:
    """What came over a block in paired rollouts; the feet are those of the built-in hexapod, others' are not known."""
    assert rollouts.attitude is not None and rollouts.position is not None
    legs = rollouts.rig.name == hexapod_rig().name
    count = len(rollouts.scenarios)
    found = OverBlocks(np.zeros(count, bool), np.zeros(count, int), np.full(count, np.nan))
    for n, scenario in enumerate(rollouts.scenarios):
        if scenario.blocks:
            rows = n, 0, slice(np.searchsorted(rollouts.time, scenario.duration + 1e-9))
            trunk = rollouts.position[rows]
            found.trunk[n] = blocks_under(trunk, scenario).any()
            found.past_s[n] = time_past(rollouts.time, trunk, scenario)
            if legs:
                points = feet(trunk, rollouts.attitude[rows], rollouts.joint_position[rows])
                found.feet[n] = blocks_under(points, scenario).sum()
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


def blocks_under(points: np.ndarray, scenario: Scenario) -> np.ndarray:
    """(blocks,) bool, within the edges of which one of the points (..., 3), m in the world, is."""
    on_plane = _on_the_ground(points, scenario)
    return np.array([_within(on_plane, block).any() for block in scenario.blocks], bool)


def time_past(time: np.ndarray, points: np.ndarray, scenario: Scenario) -> float:
    """When a path comes past the far end of the last block, along the heading at the start.

    Args:
      time: s, at least as many as there are points.
      points: (T, 3) m in the world.
      scenario: with at least one block.

    Returns:
      s; NaN if it never does.
    """
    cosine, sine = np.cos(scenario.initial_yaw), np.sin(scenario.initial_yaw)
    along = _on_the_ground(points, scenario)[:, :2] @ [cosine, sine]
    past = np.flatnonzero(along > max(_far_end(block, scenario.initial_yaw) for block in scenario.blocks))
    return float(time[past[0]]) if len(past) else np.nan


def _far_end(block: Block, heading: float) -> float:
    """m from the start to the furthest corner of a block along a heading (rad), both in the ground's frame."""
    turned = block.yaw - heading
    reach = np.abs(np.cos(turned)) * block.size[0] / 2 + np.abs(np.sin(turned)) * block.size[1] / 2
    return float(np.cos(heading) * block.center[0] + np.sin(heading) * block.center[1] + reach)


def _on_the_ground(points: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Points (..., 3), m in the world, in the frame of the ground, where the blocks are."""
    ground = quaternion_from_rpy(np.array(scenario.slope_roll), np.array(scenario.slope_pitch), np.array(0.0))
    return rotate_back(np.broadcast_to(ground, (*points.shape[:-1], 4)), points)


def _within(points: np.ndarray, block: Block) -> np.ndarray:
    """Whether each point (..., 3), m in the ground's frame, is within the block's edges, seen from above."""
    x, y = np.moveaxis(points[..., :2] - np.array(block.center[:2]), -1, 0)
    cosine, sine = np.cos(block.yaw), np.sin(block.yaw)
    along, across = cosine * x + sine * y, cosine * y - sine * x
    return (np.abs(along) <= block.size[0] / 2) & (np.abs(across) <= block.size[1] / 2)
