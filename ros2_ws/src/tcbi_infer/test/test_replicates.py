"""Which rollouts make a kind of motion, where few policies were recorded."""

import numpy as np
import pytest

from tcbi_infer.compare.replicates import find_replicates
from tcbi_sim.measurement import Commands, Measurement, Scenario

TIME = np.arange(100) / 50.0


def rollout(pace: float, policy: str, task: str = "balance") -> Measurement:
    """One joint swings `pace` times a second."""
    commands = Commands(np.arange(10) * 0.2, np.sin(2 * np.pi * pace * np.arange(10) * 0.2)[:, None])
    joints = np.zeros((100, 1))
    return Measurement("r", "servo_bench", Scenario(task, 2.0), policy, "sim", commands, ("servo",), (), TIME, joints)


def kinds(rollouts: list[Measurement]) -> list[int]:
    return [g.kind for g in find_replicates(rollouts)]


def test_rollouts_of_one_learned_policy_are_one_kind_however_their_commands_differ():
    assert kinds([rollout(pace, "balance@5f3a") for pace in (0.3, 0.7, 1.1, 1.5, 1.9)]) == [0] * 5


def test_a_learned_policy_is_another_kind_in_another_task_and_beside_another_policy():
    others = [rollout(1.1, "balance@5f3a", "forward"), rollout(1.5, "balance@77c1"), rollout(1.9, "gait:steps")]
    assert kinds([rollout(0.3, "balance@5f3a"), *others, rollout(0.7, "balance@5f3a")]) == [0, 1, 2, 3, 0]


@pytest.mark.parametrize("policy", ["", "gait:steps"])
def test_what_acts_without_feedback_is_told_apart_by_its_shape(policy):
    assert kinds([rollout(pace, policy) for pace in (0.3, 0.7, 1.1, 0.305)]) == [0, 1, 2, 0]


def test_kinds_that_one_learned_policy_ties_together_are_one():
    """The second rollout repeats the motion of one policy, the third that of another."""
    tied = [rollout(0.3, "a@1"), rollout(0.7, "b@1"), rollout(0.305, "c@1"), rollout(0.705, "c@1")]
    assert kinds([*tied, rollout(1.1, "")]) == [0, 0, 0, 0, 1]
