"""Scripted gaits: safe, repeatable, and the tripod walks."""

import numpy as np
import pytest

from tcbi_contract.names import JOINT_LIMIT
from tcbi_policy.errors import PolicyNotFound
from tcbi_policy.gaits import GAITS, MAX_CHANGE, Gait, lean
from tcbi_policy.kinematics import forward, inverse, neutral_feet
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs.hexapod import build


@pytest.mark.parametrize("name", GAITS)
def test_every_gait_stays_within_range_and_speed(name: str) -> None:
    gait = Gait(name)
    targets = np.array([gait.act(0.2 * k, np.zeros((1, 21)))[0] for k in range(300)])
    assert np.abs(targets).max() <= JOINT_LIMIT + 1e-12
    steps = np.diff(np.concatenate([np.zeros((1, 18)), targets]), axis=0)
    assert np.abs(steps).max() <= MAX_CHANGE + 1e-9


def test_a_gait_repeats_itself_and_a_seed_makes_another_one() -> None:
    np.testing.assert_array_equal(Gait("steps").targets, Gait("steps").targets)
    assert not np.array_equal(Gait("steps").targets, Gait("steps:7").targets)
    assert Gait("steps:7").policy_id == "gait:steps:7"


@pytest.mark.parametrize("name", ["moonwalk", "steps:x", ""])
def test_an_unknown_gait_is_refused(name: str) -> None:
    with pytest.raises(PolicyNotFound):
        Gait(name)


def test_excitations_move_every_joint() -> None:
    for name in ("excite", "steps", "sinus", "dither"):
        assert Gait(name).targets[:40].std(axis=0).min() > 0.03, name


def test_kinematics_are_those_of_the_simulated_robot() -> None:
    import mujoco

    model = build(0).compile()
    data = mujoco.MjData(model)
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, 18)
    data.qpos[:7], data.qpos[7:] = [0, 0, 0, 1, 0, 0, 0], angles
    mujoco.mj_kinematics(model, data)
    feet = [data.geom(f"{leg}_foot").xpos for leg in ("lf", "lm", "lr", "rf", "rm", "rr")]
    np.testing.assert_allclose(forward(angles), feet, atol=1e-9)


def test_inverse_undoes_forward() -> None:
    for angles in np.random.default_rng(1).uniform(-0.5, 0.5, (50, 18)):
        np.testing.assert_allclose(inverse(forward(angles)), angles, atol=1e-9)


def test_leaning_turns_the_feet_about_the_trunk() -> None:
    feet = forward(lean(roll=0.1))
    assert (feet[:3, 2] < neutral_feet()[:3, 2]).all() and (feet[3:, 2] > neutral_feet()[3:, 2]).all()


def test_a_stride_asks_every_foot_to_rise_above_the_tasks_blocks_and_a_tripod_walk_does_not() -> None:
    for name, low, high in (("stride", 0.085, 0.12), ("tripod", 0.03, 0.05)):
        height = forward(Gait(name).targets[40:60])[..., 2]
        rise = height.max(axis=0) - height.min(axis=0)
        assert low < rise.min() and rise.max() < high, name


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("tripod", 0.6, 1.2), ("stride", 1.0, 1.8), ("backward", -1.2, -0.6), ("stand", -0.005, 0.005)],
)
def test_the_robot_goes_where_the_gait_says(name: str, low: float, high: float) -> None:
    model = base_model("hexapod")
    out = simulate(model, model.mean()[None], [Scenario("forward", 5.0)], controller=Gait(name), timestep=0.01)
    assert out.position is not None
    moved = out.position[0, 0, -1] - out.position[0, 0, 0]
    assert low < moved[0] < high
    assert abs(moved[1]) < 0.2
