"""The training environment is the engine and the reward, nothing else."""

import numpy as np
import pytest

from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import simulated_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import observation
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")


@pytest.fixture(scope="module")
def episode() -> tuple[HexapodVectorEnv, list[np.ndarray], np.ndarray, list[dict]]:
    """One balance episode of four simulations under a gait: observations, rewards (steps, B), infos."""
    environment = HexapodVectorEnv(MODEL, "balance", 4, seed=3)
    gait = Gait("steps")
    seen, rewards, infos = [environment.reset()[0]], [], []
    for k in range(environment.steps):
        action = gait.act(0.2 * k, seen[-1]) / environment.limit
        observation, reward, terminated, truncated, info = environment.step(action)
        assert not terminated.any()
        assert truncated.all() == (k == environment.steps - 1)
        seen.append(observation)
        rewards.append(reward)
        infos.append(info)
    return environment, seen, np.array(rewards), infos


def test_rewards_and_observations_are_those_of_the_engine(episode: tuple) -> None:
    _, seen, rewards, infos = episode
    fresh = HexapodVectorEnv(MODEL, "balance", 4, seed=3)
    out = simulate(
        MODEL,
        fresh.simulator.parameters,
        fresh.simulator.scenarios,
        controller=Gait("steps"),
        pairing="zip",
        timestep=fresh.simulator.timestep,
    )
    np.testing.assert_allclose(rewards.T, simulated_rewards(out)[:, 0], atol=1e-9)
    assert out.attitude is not None
    last = observation(out.joint_position[:, 0, -1], out.attitude[:, 0, -1], 0.0)
    np.testing.assert_allclose(infos[-1]["final_obs"][:, :20], last[:, :20], atol=1e-6)
    assert all(o.shape == (4, 21) and o.dtype == np.float32 for o in seen)


def test_an_episode_lasts_as_long_as_the_task_and_the_next_one_is_another(episode: tuple) -> None:
    environment, seen, rewards, infos = episode
    assert len(rewards) == 40
    assert environment.generation == 1
    assert "final_obs" in infos[-1] and "final_obs" not in infos[-2]
    assert np.abs(seen[-1] - seen[0]).max() > 0.01


def test_a_set_of_episodes_depends_on_seed_and_number_alone(episode: tuple) -> None:
    _, seen, _, _ = episode
    later = HexapodVectorEnv(MODEL, "balance", 4, seed=3)
    later.generation = 1
    np.testing.assert_array_equal(later.reset()[0], seen[-1])
    other, _ = HexapodVectorEnv(MODEL, "balance", 4, seed=4).reset()
    assert np.abs(other - seen[0]).max() > 0.01
    np.testing.assert_array_equal(later.reset(seed=3)[0], seen[0])


def test_parameters_are_the_models_particles_and_differ_between_simulations() -> None:
    environment = HexapodVectorEnv(MODEL, "balance", 8, seed=0)
    drawn = environment.simulator.parameters
    assert all((MODEL.particles == row).all(axis=1).any() for row in drawn)
    assert len(np.unique(drawn, axis=0)) > 1


def test_squashed_actions_are_the_tanh_of_what_the_algorithm_says() -> None:
    rewards = []
    for squash, action in ((True, 0.5), (False, np.tanh(0.5))):
        environment = HexapodVectorEnv(MODEL, "balance", 2, seed=0, squash=squash)
        environment.reset()
        rewards.append(environment.step(np.full((2, 18), action))[1])
    np.testing.assert_allclose(rewards[0], rewards[1], atol=1e-9)


def test_a_forward_set_has_room_for_the_blocks_of_every_later_one() -> None:
    environment = HexapodVectorEnv(MODEL, "forward", 2, seed=0)
    for generation in range(4):
        environment.generation = generation
        environment.reset()
    assert environment.observation_space.contains(environment.step(np.zeros((2, 18)))[0])
