"""A block in a scenario is there to be stood on: a foot that is put down over one comes to rest on its top."""

import mujoco
import numpy as np
import pytest

from tcbi_contract.names import JOINT_LIMIT, JOINTS, LEGS
from tcbi_sim.measurement import Block, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs.hexapod import dimensions
from tcbi_sim.simulator import Simulator

NOMINAL = np.array([[0.75, 0.8, 2.5]])
LEG = "lf"
HEIGHT = 0.06  # m, of the lowest blocks that the task places
LANDING = (0.21, 0.18)  # m, where the lifted leg comes down


def put_down(*blocks: Block) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A robot that began with one leg as high and as far out as it goes, and brought it to the neutral stance."""
    up = {f"{LEG}_femur": JOINT_LIMIT, f"{LEG}_tibia": JOINT_LIMIT}
    posture = tuple(up.get(joint, 0.0) for joint in JOINTS)
    scenario = Scenario("forward", 3.0, blocks=blocks, initial_joint_position=posture)
    simulator = Simulator(base_model("hexapod"), NOMINAL, [scenario], threads=1)
    simulator.command(np.zeros((1, len(JOINTS))), ramp=1.0)
    simulator.advance(3.0)
    assert not simulator.diverged.any()
    return simulator.materialise()


def soles(_: mujoco.MjModel, data: mujoco.MjData) -> dict[str, float]:
    """Height of each foot's lowest point, m."""
    radius = dimensions()["leg"]["foot_radius"]
    return {leg: data.geom(f"{leg}_foot").xpos[2] - radius for leg in LEGS}


def below(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """What the leg's foot touches."""
    pairs = [{model.geom(c.geom1).name, model.geom(c.geom2).name} for c in data.contact[: data.ncon]]
    return {name for pair in pairs if f"{LEG}_foot" in pair for name in pair} - {f"{LEG}_foot"}


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_a_foot_stands_on_the_block_that_it_is_put_down_over_and_the_others_on_the_ground(yaw: float) -> None:
    far, near = (Block((*place, HEIGHT / 2), (0.15, 0.12, HEIGHT), yaw) for place in ((5.0, 5.0), LANDING))
    stood = put_down(far, near)
    expected = {leg: HEIGHT if leg == LEG else 0.0 for leg in LEGS}
    assert soles(*stood) == pytest.approx(expected, abs=1e-3)
    assert below(*stood) == {"block_1"}


def test_a_foot_beside_the_blocks_stands_on_the_ground() -> None:
    stood = put_down(Block((5.0, 5.0, HEIGHT / 2), (0.15, 0.12, HEIGHT)))
    assert soles(*stood)[LEG] == pytest.approx(0.0, abs=1e-3)
    assert below(*stood) == {"ground"}
