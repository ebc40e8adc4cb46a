"""The ground that scenarios ask for, written into the fields of their simulations."""

from collections.abc import Sequence

import mujoco
import numpy as np

from tcbi_sim.fields import Fields
from tcbi_sim.measurement import Scenario, quaternion_from_rpy


def write_terrain(fields: Fields, model: mujoco.MjModel, scenarios: Sequence[Scenario]) -> None:
    """Tilt the ground and place the blocks of each simulation.

    Args:
      fields: of B simulations.
      model: their common structure, with at least as many blocks (`block_0`, …) as any scenario has.
      scenarios: B of them.
    """
    roll = np.array([s.slope_roll for s in scenarios])
    pitch = np.array([s.slope_pitch for s in scenarios])
    ground = quaternion_from_rpy(roll, pitch, np.zeros(len(scenarios)))
    fields.model["body_quat"][:, fields.body("ground")] = ground
    placed = [(b, i, block) for b, scenario in enumerate(scenarios) for i, block in enumerate(scenario.blocks)]
    if not placed:
        return
    geoms = np.array([model.geom(f"block_{i}").id for i in range(max(i for _, i, _ in placed) + 1)])
    where = np.array([b for b, _, _ in placed]), geoms[[i for _, i, _ in placed]]
    half = np.array([block.size for _, _, block in placed]) / 2
    yaw = np.array([block.yaw for _, _, block in placed])
    fields.model["geom_pos"][where] = [block.center for _, _, block in placed]
    fields.model["geom_size"][where] = half
    fields.model["geom_quat"][where] = quaternion_from_rpy(np.zeros_like(yaw), np.zeros_like(yaw), yaw)
    fields.model["geom_rbound"][where] = np.linalg.norm(half, axis=1)
    fields.model["geom_aabb"][where] = np.concatenate([np.zeros_like(half), half], axis=1)
