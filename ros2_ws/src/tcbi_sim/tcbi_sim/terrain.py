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
    for b, scenario in enumerate(scenarios):
        for i, block in enumerate(scenario.blocks):
            geom = model.geom(f"block_{i}").id
            half = np.array(block.size) / 2
            fields.model["geom_pos"][b, geom] = block.center
            fields.model["geom_size"][b, geom] = half
            fields.model["geom_quat"][b, geom] = [np.cos(block.yaw / 2), 0, 0, np.sin(block.yaw / 2)]
            fields.model["geom_rbound"][b, geom] = np.linalg.norm(half)
            fields.model["geom_aabb"][b, geom] = [0, 0, 0, *half]
