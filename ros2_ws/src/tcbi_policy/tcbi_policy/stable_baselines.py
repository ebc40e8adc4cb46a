"""Between Stable-Baselines3 and the rest: its environment interface, its networks as artefacts, its state as arrays.

Stable-Baselines3's own archives are pickles; nothing here writes or reads one.
"""

import io
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from tcbi_contract.names import JOINTS
from tcbi_policy.configuration import TrainingConfig
from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.mlp import Mlp

OBSERVATION_SCALE = np.array(
    [2.0] * len(JOINTS) + [4.0, 4.0, 2.0]
)  # angles of some 0.5 and 0.25 rad to the order of one


class HexapodVecEnv(VecEnv):
    """The vector environment as Stable-Baselines3 wants it, with scaled observations and rewards."""

    def __init__(self, environment: HexapodVectorEnv, reward_scale: float):
        self.inner, self._reward_scale = environment, reward_scale
        bound = np.pi * OBSERVATION_SCALE.astype(np.float32)
        action = environment.single_action_space
        assert isinstance(action, Box)
        self._actions = np.zeros((environment.num_envs, *action.shape), np.float32)
        self._returns = np.zeros(environment.num_envs)
        super().__init__(environment.num_envs, Box(-bound, bound), action)

    def _scaled(self, observation: np.ndarray) -> np.ndarray:
        return (observation * OBSERVATION_SCALE).astype(np.float32)

    def reset(self) -> np.ndarray:
        """Start the episodes of the present generation."""
        self._returns[:] = 0.0
        return self._scaled(self.inner.reset()[0])

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (B, J) of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control period; the end of an episode is a time limit, never an end of the task."""
        observation, reward, _, truncated, info = self.inner.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._returns += reward
        if truncated.all():
            last = self._scaled(info["final_obs"])
            infos = [
                {"terminal_observation": row, "TimeLimit.truncated": True, "episode": {"r": r, "l": self.inner.steps}}
                for row, r in zip(last, self._returns, strict=True)
            ]
            self._returns = np.zeros(self.num_envs)
        return self._scaled(observation), (reward * self._reward_scale).astype(np.float32), truncated, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the inner environment, once for each episode."""
        if attr_name == "render_mode":
            return [None] * self.num_envs
        return [getattr(self.inner, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the inner environment."""
        setattr(self.inner, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the inner environment, once."""
        return [getattr(self.inner, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """There are no wrappers."""
        return [False] * self.num_envs


def make_algorithm(config: TrainingConfig, environment: HexapodVecEnv) -> BaseAlgorithm:
    """PPO or SAC with the configuration's settings; PPO's sets of steps are whole episodes."""
    layers = {"net_arch": list(config.layers), "activation_fn": torch.nn.Tanh}
    common: dict[str, Any] = {
        "learning_rate": config.learning_rate, "batch_size": config.batch_size, "gamma": config.gamma,
        "seed": config.seed, "device": "cpu",
    }  # fmt: skip
    if config.algorithm == "ppo":
        with warnings.catch_warnings():  # a set of whole episodes may end with a smaller minibatch than the others
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            return PPO(
                "MlpPolicy", environment, n_steps=environment.inner.steps, n_epochs=config.epochs,
                gae_lambda=config.gae_lambda, clip_range=config.clip,
                policy_kwargs={**layers, "log_std_init": float(np.log(config.noise))}, **common,
            )  # fmt: skip
    return SAC(
        "MlpPolicy", environment, tau=config.tau, gradient_steps=config.updates, train_freq=1,
        buffer_size=config.buffer, learning_starts=10 * config.batch_size, policy_kwargs=layers, **common,
    )  # fmt: skip


def freeze_actor(algorithm: BaseAlgorithm, frozen: bool) -> None:
    """Let only the value be fitted, as long as it knows nothing of a policy that is good already."""
    policy: Any = algorithm.policy
    if not hasattr(policy, "mlp_extractor"):
        return
    for part in (policy.mlp_extractor.policy_net, policy.action_net):
        part.requires_grad_(not frozen)
    policy.log_std.requires_grad_(not frozen)


def actor_layers(algorithm: BaseAlgorithm) -> list[torch.nn.Linear]:
    """The linear layers from observation to mean action, of PPO or SAC."""
    policy: Any = algorithm.policy
    if hasattr(policy, "actor"):
        modules: Sequence[torch.nn.Module] = [*policy.actor.latent_pi, policy.actor.mu]
    else:
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    return [m for m in modules if isinstance(m, torch.nn.Linear)]


def to_mlp(algorithm: BaseAlgorithm, limit: float) -> Mlp:
    """The deterministic policy as it is deployed."""
    layers = actor_layers(algorithm)
    weights = tuple(layer.weight.detach().numpy().astype(np.float64) for layer in layers)
    biases = tuple(layer.bias.detach().numpy().astype(np.float64) for layer in layers)
    return Mlp(weights, biases, OBSERVATION_SCALE.copy(), limit)


def from_mlp(algorithm: BaseAlgorithm, mlp: Mlp) -> None:
    """Start from an artefact's weights."""
    with torch.no_grad():
        for layer, weight, bias in zip(actor_layers(algorithm), mlp.weights, mlp.biases, strict=True):
            layer.weight.copy_(torch.as_tensor(weight * _rescale(mlp, weight)))
            layer.bias.copy_(torch.as_tensor(bias))


def _rescale(mlp: Mlp, weight: np.ndarray) -> np.ndarray | float:
    """The first layer of an artefact may have been trained under another observation scale."""
    if weight is not mlp.weights[0]:
        return 1.0
    return mlp.observation_scale / OBSERVATION_SCALE


def state_tensors(algorithm: BaseAlgorithm) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """All that training needs to go on: tensors by name, and the rest as JSON texts by name."""
    tensors: dict[str, torch.Tensor] = {}
    texts: dict[str, str] = {}
    for name, state in algorithm.get_parameters().items():
        if name.endswith("optimizer"):
            for index, slots in state["state"].items():
                tensors |= {f"{name}/{index}/{slot}": torch.as_tensor(value).clone() for slot, value in slots.items()}
            texts[name] = json.dumps(state["param_groups"])
        else:
            tensors |= {f"{name}/{key}": value.clone() for key, value in state.items()}
    if hasattr(algorithm, "log_ent_coef") and algorithm.log_ent_coef is not None:
        tensors["log_ent_coef"] = algorithm.log_ent_coef.detach().clone()
    return {name: tensor.contiguous() for name, tensor in tensors.items()}, texts


def restore_tensors(algorithm: BaseAlgorithm, tensors: Mapping[str, torch.Tensor], texts: Mapping[str, str]) -> None:
    """Undo `state_tensors`."""
    parameters: Any = {}
    for name in algorithm.get_parameters():
        own = {key.removeprefix(f"{name}/"): value for key, value in tensors.items() if key.startswith(f"{name}/")}
        parameters[name] = {"state": _slots(own), "param_groups": json.loads(texts[name])} if name in texts else own
    algorithm.set_parameters(parameters, exact_match=True)
    if "log_ent_coef" in tensors:
        with torch.no_grad():
            algorithm.log_ent_coef.copy_(tensors["log_ent_coef"])  # type: ignore[attr-defined]


def _slots(own: Mapping[str, torch.Tensor]) -> dict[int, dict[str, torch.Tensor]]:
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in own.items():
        index, slot = key.split("/")
        state.setdefault(int(index), {})[slot] = value
    return state


REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def replay_bytes(algorithm: BaseAlgorithm) -> bytes:
    """The steps that SAC remembers, as the bytes of an .npz file."""
    buffer: Any = algorithm.replay_buffer  # type: ignore[attr-defined]
    size = buffer.size()
    arrays = {name: getattr(buffer, name)[:size] for name in REPLAY if getattr(buffer, name, None) is not None}
    file = io.BytesIO()
    np.savez(file, pos=np.array([buffer.pos, int(buffer.full)]), **arrays)
    return file.getvalue()


def restore_replay(algorithm: BaseAlgorithm, path: Path) -> None:
    """Undo `replay_bytes`; a file of another size of buffer is refused by its shapes."""
    buffer: Any = algorithm.replay_buffer  # type: ignore[attr-defined]
    with np.load(path, allow_pickle=False) as file:
        buffer.pos, buffer.full = int(file["pos"][0]), bool(file["pos"][1])
        for name in REPLAY:
            if name in file:
                getattr(buffer, name)[: len(file[name])] = file[name]
