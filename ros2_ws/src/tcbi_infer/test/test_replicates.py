"""Which rollouts repeat each other, and which make a kind of motion, where few policies were recorded."""

import dataclasses

import numpy as np
import pytest

from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.replicates import find_replicates, same_commands, same_motion
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


def until(m: Measurement, commands: int) -> Measurement:
    """The same rollout, stopped after some commands."""
    cut = dataclasses.replace(m.commands, time=m.commands.time[:commands], target=m.commands.target[:commands])
    return dataclasses.replace(m, commands=cut)


def test_five_names_for_one_motion_are_one_kind():
    assert kinds([rollout(0.3 + 0.0015 * (i + 1), f"gait:walk{i}") for i in range(5)]) == [0] * 5
    others = [rollout(pace, f"gait:other{pace}") for pace in (0.7, 1.1, 1.5)]
    assert kinds([rollout(0.3, "a"), rollout(0.305, "b"), *others]) == [0, 0, 1, 2, 3]


def test_the_beginning_of_a_motion_is_of_its_kind():
    assert kinds([until(rollout(0.3, ""), n) for n in (10, 5, 3)]) == [0, 0, 0]
    still = dataclasses.replace(rollout(0.3, ""), commands=Commands(np.arange(3) * 0.2, np.zeros((3, 1))))
    assert kinds([rollout(0.3, ""), still]) == [0, 1], "to stand still is no motion's beginning"
    posture = np.tile([0.0, 0.5], (3, 1))
    hold, swing = (
        Commands(np.arange(len(t)) * 0.2, t) for t in (posture, np.concatenate([posture, 0.9 - posture] * 3))
    )
    assert not same_motion(hold, swing), "nor is to hold a posture, whose joints differ"
    assert not same_motion(*(Commands(np.arange(n) * 0.1, np.zeros((n, 1))) for n in (5, 50)), torque=True)


def test_a_repeat_may_stand_a_degree_off_and_its_slope_be_noted_a_little_otherwise():
    def stood(posture: float, slope: float) -> Measurement:
        scenario = Scenario("balance", 2.0, slope_roll=slope, initial_joint_position=(posture,))
        return dataclasses.replace(rollout(0.3, "gait:steps"), scenario=scenario)

    sets = find_replicates([stood(0.0, 0.1), stood(0.015, 0.101), stood(0.03, 0.1), stood(0.0, 0.11)])
    assert [s.members for s in sets] == [(0, 1), (2,), (3,)]


def test_a_simulation_is_no_repeat_of_the_robot_and_both_together_are_told():
    """Their difference would be the model's error, and pass for the robot's own scatter."""
    simulated = rollout(0.3, "gait:steps")
    robots = [dataclasses.replace(simulated, source="driver", joint_position=TIME[:, None] + i) for i in range(2)]
    assert [s.members for s in find_replicates([simulated, *robots])] == [(0,), (1, 2)]
    (line,) = [line for line in guard([simulated, *robots]) if "sources" in line]
    assert "(driver, sim)" in line and not any("is no repeat" in line for line in guard([simulated, *robots]))
    assert not any("sources" in line for line in guard(robots))


def test_a_recording_that_is_nearly_a_repeat_is_told_with_what_keeps_it_from_being_one():
    def told(**changes) -> list[str]:
        one = rollout(0.3, "gait:steps")
        second = dataclasses.replace(one, rollout_id="second", joint_position=one.joint_position + 0.1, **changes)
        return [line for line in guard([one, second]) if "no repeat" in line]

    def started(posture: float) -> Scenario:
        return Scenario("balance", 2.0, initial_joint_position=(posture,))

    def late(by: float) -> Commands:
        whole = rollout(0.3, "gait:steps").commands
        return dataclasses.replace(whole, time=whole.time + by * (whole.time > 0.5))

    assert not told() and not told(scenario=started(0.015)) and not told(commands=late(0.09)), "these are repeats"
    assert not told(scenario=started(0.11)) and not told(scenario=Scenario("forward", 2.0)), (
        "these were not meant to be"
    )
    begins = "Asks for the same as r, but is no repeat of it: they differ in "
    assert told(scenario=started(0.03))[0].startswith(begins + "the start of a joint by 0.03 rad (allowed 0.02)")
    assert told(commands=late(0.14))[0].startswith(begins + "the time of a command by 0.14 s (allowed 0.1)")
    stopped = until(rollout(0.3, ""), 7).commands
    assert told(commands=stopped)[0].startswith(begins + "the number of commands (7 and 10)")
    assert not told(commands=until(rollout(0.3, ""), 4).commands), "another, shorter motion"


def passing(speed: float | None) -> Measurement:
    """One joint is let go while it passes zero at some speed (rad/s)."""
    start = {"initial_joint_position": (0.0,), "initial_joint_velocity": None if speed is None else (speed,)}
    return dataclasses.replace(rollout(0.3, "swing"), scenario=Scenario("log", 2.0, **start))


def test_the_same_posture_at_another_speed_is_another_start():
    sets = find_replicates([passing(speed) for speed in (2.0, -2.0, 2.02, None, 0.0)])
    assert [s.members for s in sets] == [(0, 2), (1,), (3, 4)]


@pytest.mark.parametrize("size", [0.01, 1.0, 50.0])
def test_torques_repeat_each_other_up_to_a_share_of_their_spread(size):
    torques = size * np.sin(np.arange(20.0))[:, None]
    asked = Commands(np.arange(20) * 0.1, torques)
    off, other = (dataclasses.replace(asked, target=torques * share) for share in (1.005, 1.05))
    assert same_commands(asked, off, torque=True) and not same_commands(asked, other, torque=True)
    assert same_motion(asked, other, torque=True)
    assert not same_motion(asked, dataclasses.replace(asked, target=torques * 1.2), torque=True)


def test_a_rig_driven_by_torque_is_judged_by_its_torques():
    """Torques of a few mN m are all a small motor gives: twice as much is no repeat."""
    weak, strong = (
        dataclasses.replace(
            rollout(0.3, "a"), rig="double_pendulum", commands=Commands(TIME[:10], size * np.eye(10, 2))
        )
        for size in (1e-3, 2e-3)
    )
    assert [s.members for s in find_replicates([weak, strong, weak])] == [(0, 2), (1,)]


def test_swings_without_torque_repeat_each_other():
    free = Commands(np.zeros(1), np.zeros((1, 2)))
    assert same_commands(free, free, torque=True) and same_motion(free, free, torque=True)


def test_motions_about_a_bent_posture_are_as_many_kinds_as_about_zero():
    """How far joints stand apart says nothing of how far they move."""
    posture, t = np.array([0.0, -1.75, 1.6, 0.75, 0.0, 0.2]), np.arange(50) * 0.1

    def sine(joint: int) -> Commands:
        targets = np.zeros((50, 6))
        targets[:, joint] = 0.15 * np.sin(2 * np.pi * 0.5 * t)
        return Commands(t, posture + targets)

    assert same_motion(sine(1), sine(1))
    assert not any(same_motion(sine(a), sine(b)) for a in range(6) for b in range(a))
