"""The hexapod stands, steps over the blocks, and measures what the contract says."""

import math

import mujoco
import numpy as np
import pytest

from tcbi_contract.names import JOINT_LIMIT, JOINTS, LEGS
from tcbi_sim.measurement import Scenario, roll_pitch_yaw
from tcbi_sim.model import base_model
from tcbi_sim.rigs.hexapod import GROUND, ROBOT, build, dimensions
from tcbi_sim.simulator import Simulator
from tcbi_sim.tasks import BLOCK_HEIGHT, TASKS

NOMINAL = np.array([[0.75, 0.8, 2.5]])


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build().compile()


def foot(model: mujoco.MjModel, leg: str, **angles: float) -> np.ndarray:
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.qpos[model.joint(f"{leg}_{joint}").qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    return data.site(f"{leg}_foot").xpos.copy()


def test_it_has_the_contracts_joints_in_order_and_weighs_what_table_1_allows(model):
    hinges = [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE]
    assert tuple(hinges) == JOINTS
    assert 0.4 <= model.body_mass.sum() <= 1.2
    assert model.body_mass.sum() == pytest.approx(dimensions()["nominal"]["mass"])


@pytest.mark.parametrize("leg", LEGS)
def test_positive_angles_move_every_foot_as_the_contract_says(model, leg):
    rest = foot(model, leg)
    outward = 1.0 if leg.startswith("l") else -1.0
    assert foot(model, leg, coxa=0.2)[0] > rest[0] + 0.01, "coxa positive swings the foot forward"
    assert foot(model, leg, femur=0.2)[2] > rest[2] + 0.01, "femur positive lifts"
    assert outward * foot(model, leg, tibia=0.2)[1] > outward * rest[1] + 0.005, "tibia positive moves the foot outward"


@pytest.mark.parametrize("leg", LEGS)
def test_a_foot_lifts_over_the_highest_block_within_the_joint_range(model, leg):
    lift = foot(model, leg, femur=JOINT_LIMIT, tibia=JOINT_LIMIT)[2] - foot(model, leg)[2]
    assert lift > BLOCK_HEIGHT[1]


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.25, 0.0), (0.1, -0.3)])
def test_loaded_feet_do_not_creep(slope):
    scenario = Scenario("balance", 10.0, *slope, settle=2.0)
    simulator = Simulator(base_model("hexapod"), NOMINAL, [scenario], threads=1)
    before = _feet(simulator)
    simulator.command(np.zeros((1, 18)))
    simulator.advance(10.0)
    crept = np.linalg.norm(_feet(simulator) - before, axis=1).max()
    assert crept < 1e-3, f"a foot moved {1e3 * crept:.2f} mm in 10 s of standing still"


def _feet(simulator: Simulator) -> np.ndarray:
    _, data = simulator.materialise()
    return np.array([data.site(f"{leg}_foot").xpos for leg in LEGS])


def test_standing_on_a_slope_the_imu_shows_the_slope_and_gravity():
    scenario = Scenario("balance", 8.0, 0.2, -0.1, settle=2.0)
    now = Simulator(base_model("hexapod"), NOMINAL, [scenario], threads=1).observe()
    assert now.attitude is not None and now.linear_acceleration is not None and now.contact is not None
    assert roll_pitch_yaw(now.attitude)[0, 0] == pytest.approx([0.2, -0.1, 0.0], abs=0.03)
    assert np.linalg.norm(now.linear_acceleration[0, 0]) == pytest.approx(9.81, abs=0.1)
    assert now.contact.all(), "all six feet carry"


def touching(model: mujoco.MjModel, pose: np.ndarray) -> set[frozenset[str]]:
    """Pairs of the robot's parts that touch in a pose (18,) rad, high above the ground."""
    data = mujoco.MjData(model)
    data.qpos[2] = 1.0
    data.qpos[[model.joint(joint).qposadr[0] for joint in JOINTS]] = pose
    mujoco.mj_fwdPosition(model, data)
    return {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact[: data.ncon]}


NEIGHBOURS = [("lf", "lm"), ("lm", "lr"), ("rf", "rm"), ("rm", "rr")]


@pytest.mark.parametrize("pair", NEIGHBOURS, ids="-".join)
def test_legs_that_cross_collide(pair):
    simulated, _ = Simulator(base_model("hexapod"), NOMINAL, [Scenario("balance", 1.0)], threads=1).materialise()
    crossed = np.zeros(18)  # at 0.8 rad, beyond the commanded range, within which no two legs reach each other
    crossed[JOINTS.index(f"{pair[0]}_coxa")], crossed[JOINTS.index(f"{pair[1]}_coxa")] = -0.8, 0.8
    found = touching(simulated, crossed)
    assert frozenset(f"{leg}_femur" for leg in pair) in found
    assert {name[:2] for parts in found for name in parts} == set(pair)
    for geom in range(simulated.ngeom):
        if simulated.geom_contype[geom] == ROBOT:
            simulated.geom_conaffinity[geom] = GROUND
    assert not touching(simulated, crossed), "the pair above is there because the robot's parts meet each other"


def test_no_command_within_the_joint_range_brings_two_parts_together(model):
    rng = np.random.default_rng(0)
    poses = JOINT_LIMIT * rng.uniform(-1.0, 1.0, (1000, 18))
    poses[::2] = JOINT_LIMIT * np.sign(poses[::2])  # half of them in the corners
    assert not set().union(*(touching(model, pose) for pose in poses))


def test_scenarios_stay_within_table_1():
    rng = np.random.default_rng(0)
    for seed in range(50):
        tilted, ahead = TASKS["balance"].draw(rng, seed), TASKS["forward"].draw(rng, seed)
        assert max(abs(tilted.slope_roll), abs(tilted.slope_pitch)) <= math.pi / 6
        assert ahead.blocks and all(0.06 <= b.size[2] <= 0.08 for b in ahead.blocks)
        assert all(0.1 <= edge <= 0.2 for b in ahead.blocks for edge in b.size[:2])
        # all along the way, not at its beginning alone
        assert min(b.center[0] for b in ahead.blocks) < 2.0 and max(b.center[0] for b in ahead.blocks) > 6.0


@pytest.mark.parametrize("settle", [0.0, 0.05, 0.1, 0.102, 0.4])
def test_it_settles_for_as_long_as_asked_and_then_steps_as_asked(settle):
    simulator = Simulator(base_model("hexapod"), NOMINAL, [Scenario("balance", 1.0, settle=settle)], 0.002)
    assert simulator.materialise()[0].opt.timestep == 0.002
    assert simulator.materialise()[1].time == pytest.approx(settle, abs=0.003)
