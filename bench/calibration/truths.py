"""Rollouts whose parameters are known: of the model itself, or of an emulated robot that the model never saw."""

import dataclasses
import functools

import numpy as np

from tcbi_bringup.emulated_robot.as_measurement import measure
from tcbi_bringup.emulated_robot.hidden_effects import NONE
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_infer.collection import Request, scenario_of
from tcbi_policy.artefact import find_policy
from tcbi_policy.evaluation import noisy
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement, quaternion_from_rpy
from tcbi_sim.model import base_model
from tcbi_sim.rig import Noise
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import multiply

RIG = "hexapod"
INFERENCES = 10**6  # seeds of inferences lie beyond those of truths, whose draws they must not share
FINE_STEP = 0.002  # s, of the model as truth; an inference takes 0.005
POLICIES = {"balance": ("balance", "gait:steps"), "forward": ("forward", "gait:tripod")}  # in turn


@functools.lru_cache(maxsize=2)
def recorded(
    source: str, task: str, truth: int, rollouts: int, duration: float, sigma: float = 0.0
) -> tuple[np.ndarray, list[Measurement]]:
    """Parameters (P,) and rollouts; half of them by the trained policy of the task, half by a scripted gait.

    Noise of `sigma` (rad) beyond the sensors' own is on what the policy sees and on what is recorded: equation 14.

    Args:
      source: "model", "robot" (emulated, nothing hidden) or "hidden" (one of the effects, drawn with the robot).
      task: as registered.
      truth: its number.
      rollouts: how many.
      duration: s of each.
      sigma: rad.
    """
    policies = [noisy(find_policy(name), sigma) for name in POLICIES[task]]
    scenarios = [scenario_of(Request(task, 1, 1000 * truth + i, duration_s=duration), 0) for i in range(rollouts)]
    model, found = base_model(RIG), []
    if source != "model":
        robot = EmulatedRobot(5000 + truth, NONE if source == "robot" else None)
        known = robot.specimen.truth()
        values = np.array([float(str(known[name])) for name in model.names])
        for i, scenario in enumerate(scenarios):
            rollout = measure(robot, scenario, policies[i % 2], trial=i, policy_id=policies[i % 2].policy_id)
            found.append(dataclasses.replace(rollout, rollout_id=f"robot-{truth}-{i}"))
        return values, with_state_noise(found, sigma, truth)
    rng = np.random.default_rng([truth, 7])
    values = model.from_unit(rng.random((1, len(model.names))))
    for which, policy in enumerate(policies):
        mine = scenarios[which::2]
        out = simulate(model, values, mine, controller=policy, noise=load_rig(RIG).noise, timestep=FINE_STEP)
        found += [
            with_noise(out.measurement(0, s, f"model-{truth}-{which}-{s}", policy.policy_id), load_rig(RIG).noise, rng)
            for s in range(len(mine))
        ]
    return values[0], with_state_noise(found, sigma, truth)


def with_state_noise(rollouts: list[Measurement], sigma: float, seed: int) -> list[Measurement]:
    """White noise of standard deviation sigma (rad) on the recorded state, joint angles and attitude."""
    if sigma == 0:
        return rollouts
    rng = np.random.default_rng([seed, 14])
    return [with_noise(m, Noise(joint_position=sigma, attitude=sigma, angular_velocity=0.0), rng) for m in rollouts]


def with_noise(m: Measurement, noise: Noise, rng: np.random.Generator) -> Measurement:
    """A measurement with white noise on its readings, and joint angles in the encoder's steps."""
    attitude, rates, position = m.attitude, m.angular_velocity, m.position
    if attitude is not None and noise.attitude > 0:
        roll, pitch = noise.attitude * rng.standard_normal((2, len(attitude)))
        attitude = multiply(attitude, quaternion_from_rpy(roll, pitch, np.zeros_like(roll)))
    if rates is not None:
        rates = rates + noise.angular_velocity * rng.standard_normal(rates.shape)
    joints = m.joint_position + noise.joint_position * rng.standard_normal(m.joint_position.shape)
    if noise.encoder_step > 0:
        joints = noise.encoder_step * np.rint(joints / noise.encoder_step)
    if position is not None:
        position = position + noise.position * rng.standard_normal(position.shape)
    return dataclasses.replace(m, joint_position=joints, attitude=attitude, angular_velocity=rates, position=position)
