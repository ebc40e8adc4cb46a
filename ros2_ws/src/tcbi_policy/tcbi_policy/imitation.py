"""Teach a policy a cyclic gait before it learns by reward.

A policy sees joint angles and attitude, no clock. But the joint angles tell where in its cycle a gait is, since each
posture of the cycle is another one; so a network that maps each posture to the next one walks. The network first copies
the gait as it runs, then walks itself while every state that it comes to is labelled with the posture after the nearest
one of the cycle (dataset aggregation, Ross et al. 2011), which teaches it to come back to the cycle.
"""

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.stable_baselines import OBSERVATION_SCALE, actor_layers, to_mlp

MINIBATCH = 512
UPDATES = 1200  # gradient steps a round
ASK_EVERY = 50  # of them whether time is up


def next_posture(cycle: np.ndarray, joint_position: np.ndarray) -> np.ndarray:
    """The posture (B, J) of a cycle (n, J) that follows the one nearest to the joint angles (B, J), rad."""
    distance = np.square(joint_position[:, None, :] - cycle).sum(axis=-1)
    return cycle[(distance.argmin(axis=1) + 1) % len(cycle)]


def imitate(
    algorithm: BaseAlgorithm,
    environment: HexapodVectorEnv,
    cycle: np.ndarray,
    rounds: int,
    report: Callable[[int, float], None],
    ended: Callable[[], bool] = lambda: False,
) -> None:
    """Fit the actor to a gait.

    Args:
      algorithm: its actor is changed in place.
      environment: where it walks; unsquashed actions.
      cycle: (n, J) rad.
      rounds: sets of episodes; the teacher walks in the first.
      report: called with the round and the remaining error (rad, root mean square).
      ended: asked at every step and every `ASK_EVERY` updates; once it is true the actor stays as it is.
    """
    seen, wanted = [], []
    optimizer = torch.optim.Adam([p for layer in actor_layers(algorithm) for p in layer.parameters()], lr=1e-3)
    rng = np.random.default_rng(0)
    for number in range(rounds):
        student = to_mlp(algorithm, environment.limit)
        observation, _ = environment.reset()
        for step in range(environment.steps):
            if ended():
                return
            label = (
                next_posture(cycle, observation[:, : cycle.shape[1]])
                if number
                else np.tile(cycle[step % len(cycle)], (len(observation), 1))
            )
            seen.append(observation)
            wanted.append(label)
            action = student(observation) if number else label
            if step < environment.steps - 1:
                observation = environment.step(action / environment.limit)[0]
        environment.generation += 1
        pairs = np.concatenate(seen), np.concatenate(wanted)
        error = _fit(algorithm, optimizer, *pairs, environment.limit, rng, ended)
        if ended():
            return
        report(number, error)


def _fit(
    algorithm: BaseAlgorithm,
    optimizer: torch.optim.Optimizer,
    seen: np.ndarray,
    wanted: np.ndarray,
    limit: float,
    rng: np.random.Generator,
    ended: Callable[[], bool],
) -> float:
    """Minimise the squared error of the targets; returns the root of its mean over the last tenth, rad."""
    inputs = torch.as_tensor((seen * OBSERVATION_SCALE).astype(np.float32))
    labels = torch.as_tensor(wanted.astype(np.float32))
    layers, errors = actor_layers(algorithm), []
    for update in range(UPDATES):
        if update % ASK_EVERY == 0 and ended():
            break
        rows = torch.as_tensor(rng.integers(len(seen), size=MINIBATCH))
        hidden = inputs[rows]
        for layer in layers:
            hidden = torch.tanh(layer(hidden))
        loss = torch.nn.functional.mse_loss(limit * hidden, labels[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(loss.item())
    return float(np.sqrt(np.mean(errors[-UPDATES // 10 :] or [np.nan])))
