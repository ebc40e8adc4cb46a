"""The training environment: one episode of a task in many simulations at once, on the batch engine.

    environment = HexapodVectorEnv(model, "balance", count=256, seed=0)
    observation, info = environment.reset()
    observation, reward, terminated, truncated, info = environment.step(action)

Every episode has its own physical parameters, drawn from the model's particles, and its own scenario; any model will
do: a version, a posterior, or one of `randomisation.py`, in which each episode has some effects and not others.
Episodes never end early: all of them are truncated together at the task's duration, and the next ones begin in the
same step (Gymnasium's SAME_STEP: the last observations are in `info["final_obs"]`). Episode set g of seed s is a
function of (s, g) alone, so that a training run that was killed can go on as if nothing had happened. Physics and
reward are the engine's and `reward.step_rewards`; there is no copy of either here.

`HexapodEnv` is one such simulation behind Gymnasium's single-environment interface, registered as `tcbi/Balance-v0` and
`tcbi/Forward-v0` by `register()`.
"""

import dataclasses
import math
import secrets
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

from tcbi_contract.errors import describe
from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_policy.errors import TrainingError
from tcbi_policy.layout import HEXAPOD, check_fit, robot_layout
from tcbi_policy.reward import inclination, progress, step_rewards
from tcbi_sim.engine import Simulator
from tcbi_sim.measurement import Block, Scenario, observation, roll_pitch_yaw
from tcbi_sim.model import Model, base_model
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import Samples
from tcbi_sim.store import ModelStore
from tcbi_sim.tasks import find_task, tasks

TIMESTEP_S = 0.01  # implicitfast with the elliptic cone follows finer steps within 0.15 degrees
SQUASH_BOUND = 3.0  # tanh(3) is 0.995
SPARE = Block((9.0, 9.0, 0.05), (0.1, 0.1, 0.1))  # out of the way


class HexapodVectorEnv(VectorEnv):
    """B episodes of one task in step; observation (B, J + 3) rad, action (B, J).

    Attributes:
      generation: which set of episodes runs; set it before `reset` to go on from there.
      limit: rad, the joint range.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        model: Model,
        task: str,
        count: int,
        seed: int | None = None,
        *,
        squash: bool = False,
        observation_noise: float = 0.0,
        timestep: float = TIMESTEP_S,
        threads: int = 0,
    ):
        """Make the simulations.

        Args:
          model: its particles give each episode's parameters.
          task: a registered task.
          count: B.
          seed: of parameters and scenarios; None for another one each time.
          squash: the action is in [-3, 3] and the joint target is limit * tanh(action), instead of an action in
            [-1, 1] that is multiplied by the limit.
          observation_noise: rad, standard deviation of white noise on every entry of the observation (the paper's
            equation 14); the reward sees the true state.
          timestep: s of the physics.
          threads: 0 for all processors.

        Raises:
          PolicyMisfit: the model is of a robot that these tasks cannot move; it says what differs.
          TrainingError: no simulations, or a time step, threads or noise that cannot be.
        """
        rig = load_rig(model.rig)
        check_fit(f"of {task}", HEXAPOD, robot_layout(rig.joint_names, rig.joint_range))
        if count < 1:
            raise TrainingError(describe("count", count, "1 or more simulations"))
        if not 0 < timestep <= CONTROL_PERIOD_S:
            raise TrainingError(describe("timestep", timestep, f"more than 0 s, and {CONTROL_PERIOD_S} s at most"))
        if threads < 0:
            raise TrainingError(describe("threads", threads, "0 for all processors, or more"))
        if not 0 <= observation_noise < math.inf:
            raise TrainingError(describe("observation_noise", observation_noise, "0 or more, and finite, rad"))
        self.model, self.task, self.num_envs, self.generation = model, find_task(task), count, 0
        self._seed = secrets.randbits(32) if seed is None else seed
        self._squash, self._observation_noise = squash, observation_noise
        self._begun: int | None = None  # the generation that runs
        self._taken = 0  # steps of it
        self._noise = np.random.default_rng(0)
        parameters, scenarios = self._draw()
        blocks = (scenarios[0].blocks or (SPARE,)) * self.task.blocks  # room for as many as there may ever be
        room = dataclasses.replace(scenarios[0], blocks=blocks[: self.task.blocks])
        self.simulator = Simulator(model, parameters, [room, *scenarios[1:]], timestep, threads)
        joints = len(self.simulator.rig.joint_names)
        self.limit = self.simulator.rig.joint_range
        bound = SQUASH_BOUND if squash else 1.0
        high = np.full(joints + 3, np.pi, np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-high, high)
        self.single_action_space = gymnasium.spaces.Box(-bound, bound, (joints,), np.float32)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, count)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, count)
        self.steps = round(self.task.duration / CONTROL_PERIOD_S)

    def _draw(self) -> tuple[np.ndarray, list[Scenario]]:
        """Parameters (B, P) and scenarios of the present generation."""
        rng = np.random.default_rng([self._seed, self.generation])
        parameters = self.model.sample(rng, self.num_envs)
        return parameters, [self.task.draw(rng, int(rng.integers(2**31))) for _ in range(self.num_envs)]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the episodes of the present generation, or of the next one if steps of it have been taken.

        A seed starts again from generation 0; it is one for all episodes, as Gymnasium's VectorEnv has it.

        Raises:
          ValueError: the seed is no whole number from 0.
        """
        if seed is not None:
            if not isinstance(seed, int | np.integer) or seed < 0:
                raise ValueError(describe("seed", seed, "one whole number from 0, for all episodes together"))
            self._seed, self.generation = int(seed), 0
        elif self._taken and self.generation == self._begun:
            self.generation += 1
        self._begin()
        return self._observation(), {}

    def _begin(self) -> None:
        parameters, self._scenarios = self._draw()
        self._noise = np.random.default_rng([self._seed, self.generation, 15485863])
        self.simulator.reset(parameters=parameters, scenarios=self._scenarios, rewind=True)
        start = [s.initial_joint_position or np.zeros(len(self.simulator.rig.joint_names)) for s in self._scenarios]
        self._previous = np.array(start, float)
        self._heading = np.array([s.initial_yaw for s in self._scenarios])
        self._now = self.simulator.observe()
        self._origin = self._position(self._now)
        self._yaw = roll_pitch_yaw(self._attitude(self._now))[:, 2]
        self._begun, self._taken = self.generation, 0

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of all episodes; actions (B, J).

        Raises:
          ResetNeeded: no episode has begun.
          ValueError: the actions are of another shape, or one is NaN or infinite.
        """
        if self._begun is None:
            raise ResetNeeded("no episode has begun; call reset() before step()")
        action = np.asarray(action, float)
        if action.shape != self.action_space.shape:
            expected = f"{self.action_space.shape}, a value for each joint of each episode"
            raise ValueError(describe("shape of the actions", action.shape, expected))
        if not np.isfinite(action).all():
            raise ValueError(describe("action", action[~np.isfinite(action)][0], "finite numbers"))
        target = self.limit * (np.tanh(action) if self._squash else np.clip(action, -1.0, 1.0))
        self.simulator.command(target)
        before, self._now = self._now, self.simulator.advance(CONTROL_PERIOD_S, forces=False)
        reward = self._reward(before, target)
        self._previous = target
        self._taken += 1
        ended = np.full(self.num_envs, self._taken == self.steps)
        info: dict[str, Any] = {"diverged": self.simulator.diverged.copy()}
        if ended.all():
            info |= {"final_obs": self._observation(), "_final_obs": ended, "final_info": self._outcome()}
            info["_final_info"] = ended
            self.generation += 1
            self._begin()
        return self._observation(), reward, np.zeros(self.num_envs, bool), ended, info

    def _reward(self, before: Samples, target: np.ndarray) -> np.ndarray:
        """Rewards (B,); a simulation that diverged earns nothing from then on, or the highest of costs."""
        attitude = np.stack([self._attitude(before), self._attitude(self._now)], axis=1)
        way = np.stack([self._origin, self._position(before), self._position(self._now)], axis=1)
        moved = progress(way, self._heading)[:, 1:]
        reward = step_rewards(self.task.name, attitude, moved, target[:, None], self._previous)[:, 0]
        lost = self.simulator.diverged | ~np.isfinite(reward)
        return np.where(lost, np.min(reward[~lost], initial=0.0), reward)

    def _outcome(self) -> dict[str, np.ndarray]:
        """What came of each episode: final inclination (rad) and distance (m)."""
        way = np.stack([self._origin, self._position(self._now)], axis=1)
        return {"inclination": inclination(self._attitude(self._now)), "distance": progress(way, self._heading)[:, -1]}

    def _observation(self) -> np.ndarray:
        seen = observation(self._now.joint_position[:, -1], self._attitude(self._now), self._yaw)
        if self._observation_noise:
            seen = seen + self._observation_noise * self._noise.standard_normal(seen.shape)
        return np.nan_to_num(seen, posinf=0.0, neginf=0.0).clip(-np.pi, np.pi).astype(np.float32)

    @staticmethod
    def _attitude(samples: Samples) -> np.ndarray:
        assert samples.attitude is not None
        return samples.attitude[:, -1]

    @staticmethod
    def _position(samples: Samples) -> np.ndarray:
        assert samples.position is not None
        return samples.position[:, -1]


class HexapodEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One episode at a time of one simulation; arguments as for `HexapodVectorEnv`."""

    metadata = {"render_modes": []}

    def __init__(self, model: Model | str = "", task: str = "balance", seed: int | None = None, **options: Any):
        """Make the simulation; see `model_of` for the model."""
        self._vector = HexapodVectorEnv(model_of(model), task, 1, seed, **options)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space
        self._next: np.ndarray | None = None  # first observation of an episode that has begun already

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the next episode; a seed starts again from its first one."""
        super().reset(seed=seed)
        if seed is not None or self._next is None:
            self._next = self._vector.reset(seed=seed)[0][0]
        first, self._next = self._next, None
        return first, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period; the time limit truncates, nothing terminates."""
        observation, reward, _, truncated, info = self._vector.step(np.asarray(action)[None])
        facts: dict[str, Any] = {"diverged": bool(info["diverged"][0])}
        if not truncated[0]:
            return observation[0], float(reward[0]), False, False, facts
        self._next = observation[0]
        facts |= {name: float(values[0]) for name, values in info["final_info"].items()}
        return info["final_obs"][0], float(reward[0]), False, True, facts


def register() -> None:
    """Make every task known to `gymnasium.make` and `make_vec`, as `tcbi/<Task>-v0`."""
    for task in tasks():
        name = f"tcbi/{task.capitalize()}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:HexapodEnv",
                vector_entry_point=f"{__name__}:make_vector_env",
                kwargs={"task": task},
                order_enforce=False,
            )


def make_vector_env(num_envs: int, task: str, model: Model | str = "", **options: Any) -> HexapodVectorEnv:
    """What `gymnasium.make_vec` calls; see `model_of` for the model."""
    return HexapodVectorEnv(model_of(model), task, num_envs, **options)


def model_of(model: Model | str) -> Model:
    """A model as it is, a version of the store by its name, or for "" the prior of the hexapod as it is built in.

    Raises:
      TcbiError: the store has no such version.
    """
    if isinstance(model, Model):
        return model
    return ModelStore().load(model) if model else base_model("hexapod")
