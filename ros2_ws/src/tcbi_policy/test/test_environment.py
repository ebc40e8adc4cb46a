"""The training environment is the engine and the reward, nothing else."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from tcbi_contract.errors import TcbiError
from tcbi_policy.environment import HexapodEnv, HexapodVectorEnv, register
from tcbi_policy.errors import PolicyError
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import simulated_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Block, Scenario, observation
from tcbi_sim.model import base_model
from tcbi_sim.tasks import Task, including

MODEL = base_model("hexapod")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_refused(value: float) -> None:
    environment = HexapodEnv(MODEL, "balance", 3)
    environment.reset()
    action = np.zeros(18)
    action[4] = value
    with pytest.raises(ValueError, match=r"action: got .*allowed is finite numbers"):
        environment.step(action)


@pytest.mark.parametrize("shape", [(18,), (3, 18), (2, 17)])
def test_actions_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    environment = HexapodVectorEnv(MODEL, "balance", 2, 3)
    environment.reset()
    with pytest.raises(ValueError, match=r"shape of the actions: got .*allowed is \(2, 18\)"):
        environment.step(np.zeros(shape))


def test_the_seed_is_one_for_all_episodes() -> None:
    with pytest.raises(ValueError, match=r"seed: got \[1, 2\], allowed is one whole number"):
        HexapodVectorEnv(MODEL, "balance", 2, 3).reset(seed=[1, 2])  # type: ignore[arg-type]


def test_a_model_may_be_a_version_of_the_store() -> None:
    register()
    with pytest.raises(TcbiError, match="hexapod-v99"):
        gymnasium.make_vec("tcbi/Balance-v0", num_envs=1, model="hexapod-v99")
    assert gymnasium.make_vec("tcbi/Balance-v0", num_envs=1, model="hexapod-v0").num_envs == 1


def test_a_step_before_an_episode_says_what_is_missing() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        HexapodEnv(MODEL, "balance").step(np.zeros(18))


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


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"count": 0}, "count: got 0, allowed is 1 or more"),
        ({"count": 1, "timestep": 0.0}, "timestep: got 0.0, allowed is more than 0 s"),
        ({"count": 1, "threads": -1}, "threads: got -1, allowed is 0"),
        ({"count": 1, "observation_noise": float("nan")}, "observation_noise: got nan"),
        ({"count": 1, "model": base_model("servo_bench")}, "does not fit this robot: observation needs lf_coxa"),
    ],
)
def test_what_cannot_be_simulated_is_refused_by_what_is_wrong(given: dict, said: str) -> None:
    with pytest.raises(PolicyError, match=said):
        HexapodVectorEnv(**{"model": MODEL, "task": "balance", **given})


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
    # 9000 a radian: rounding of the times at which contacts are solved shows in the ninth digit of angles, where a foot
    # slips in the fifth
    apart = np.abs(rewards.T - simulated_rewards(out)[:, 0])
    assert np.median(apart) < 1e-5 and apart.max() < 0.5
    assert out.attitude is not None
    last = observation(out.joint_position[:, 0, -1], out.attitude[:, 0, -1], 0.0)
    np.testing.assert_allclose(infos[-1]["final_obs"][:, :20], last[:, :20], atol=1e-4)
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
    action = np.full((4, 18), 0.3)
    whole = HexapodVectorEnv(MODEL, "balance", 4, seed=3)
    whole.reset()
    for _ in range(whole.steps):
        whole.step(action)
    for ours, theirs in zip(later.step(action)[:2], whole.step(action)[:2], strict=True):
        np.testing.assert_array_equal(ours, theirs)  # to the last bit, or a resumed training drifts away
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


def test_a_single_environment_passes_the_checks_of_gymnasium_and_stable_baselines() -> None:
    register()
    check_env(gymnasium.make("tcbi/Balance-v0").unwrapped, skip_render_check=True)
    sb3_check_env(HexapodEnv(MODEL, "forward"), warn=True)


def test_the_vector_environment_keeps_gymnasiums_promises() -> None:
    register()
    environment = gymnasium.make_vec("tcbi/Balance-v0", num_envs=3)
    assert environment.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    recorded = RecordEpisodeStatistics(environment)
    first, _ = recorded.reset(seed=5)
    assert first in environment.observation_space
    environment.action_space.seed(0)
    total = np.zeros(3)
    for _ in range(40):
        observation, reward, terminated, truncated, info = recorded.step(environment.action_space.sample())
        assert observation in environment.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (3,) and truncated.dtype == bool
        total += reward
    assert truncated.all() and info["_final_obs"].all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
    np.testing.assert_array_equal(recorded.reset(seed=5)[0], first)


def test_an_episode_of_the_single_environment_is_that_of_a_vector_of_one() -> None:
    single, vector = HexapodEnv(MODEL, "balance", 3), HexapodVectorEnv(MODEL, "balance", 1, 3)
    pairs = [(single.reset()[0], vector.reset()[0][0])]
    action, ended = np.full(18, 0.1, np.float32), False
    while not ended:
        one, _, _, ended, facts = single.step(action)
        many, _, _, _, info = vector.step(action[None])
        pairs.append((one, info["final_obs"][0] if ended else many[0]))
    assert set(facts) == {"diverged", "inclination", "distance"}
    pairs.append((single.reset()[0], many[0]))
    for ours, theirs in pairs:
        np.testing.assert_array_equal(ours, theirs)


def test_observation_noise_has_the_size_that_was_asked_for_and_leaves_the_reward_alone() -> None:
    clean, noisy = (HexapodVectorEnv(MODEL, "balance", 64, 1, observation_noise=s) for s in (0.0, 0.05))
    difference = noisy.reset()[0] - clean.reset()[0]
    assert difference.std() == pytest.approx(0.05, rel=0.1)
    actions = np.zeros((64, 18))
    np.testing.assert_array_equal(noisy.step(actions)[1], clean.step(actions)[1])
    again, _ = noisy.reset()
    np.testing.assert_array_equal(again, noisy.reset()[0])


def test_a_simulation_that_diverges_never_earns_more_than_the_worst_of_the_others(monkeypatch) -> None:
    environment = HexapodVectorEnv(MODEL, "balance", 3, 1)
    environment.reset()
    for rewards, expected in (((5.0, 9.0, 2.0), 0.0), ((-5.0, 9.0, -2.0), -5.0)):
        monkeypatch.setattr("tcbi_policy.environment.step_rewards", lambda *_, given=rewards: np.array(given)[:, None])
        environment.simulator.diverged[:] = [False, True, False]
        given = environment.step(np.zeros((3, 18)))[1]
        np.testing.assert_array_equal(given, [rewards[0], expected, rewards[2]])


def test_there_is_room_for_blocks_that_no_first_scenario_has() -> None:
    def rarely(rng: np.random.Generator, seed: int) -> Scenario:
        return Scenario("rarely", 0.4, blocks=(Block((1.0, 0.0, 0.03), (0.1, 0.1, 0.06)),) * 2 * (seed % 7 == 0))

    with including(Task("rarely", 0.4, "blocks now and then", 2, rarely)):
        environment = HexapodEnv(MODEL, "rarely", seed=2)
        for _ in range(30):
            environment.reset()
            environment.step(np.zeros(18))
            environment.step(np.zeros(18))


def test_a_reset_in_mid_episode_begins_the_next_one_and_a_seed_the_first() -> None:
    for environment in (HexapodEnv(MODEL, "balance", 3), HexapodVectorEnv(MODEL, "balance", 2, 3)):
        action = 0.0 * environment.action_space.sample()
        first = environment.reset()[0]
        np.testing.assert_array_equal(environment.reset()[0], first)  # nothing of it has been seen
        environment.step(action)
        second = environment.reset()[0]
        assert np.abs(second - first).max() > 0.01
        environment.step(action)
        np.testing.assert_array_equal(environment.reset(seed=3)[0], first)


def test_a_generation_that_was_set_in_mid_episode_is_the_one_that_begins() -> None:
    environment, other = (HexapodVectorEnv(MODEL, "balance", 2, 3) for _ in range(2))
    environment.reset()
    environment.step(np.zeros((2, 18)))
    environment.generation = other.generation = 5
    np.testing.assert_array_equal(environment.reset()[0], other.reset()[0])
    assert environment.generation == 5


def test_environments_without_a_seed_are_no_copies_of_one_another() -> None:
    starts = [HexapodEnv(MODEL, "balance").reset()[0] for _ in range(2)]
    starts += [HexapodVectorEnv(MODEL, "balance", 1).reset()[0][0] for _ in range(2)]
    assert len(np.unique(starts, axis=0)) == 4
