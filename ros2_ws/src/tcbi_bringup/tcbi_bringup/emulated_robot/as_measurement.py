"""Rollouts of the emulated robot as the project's own measurements, for comparison and diagnosis without a bag.

The one module of this folder that knows the model's package, and of that only its types of what was asked and measured.
"""

import numpy as np

from tcbi_bringup.emulated_robot.mechanics import Box, Scene
from tcbi_bringup.emulated_robot.rollout import Controller, EmulatedRobot, Recording, Script
from tcbi_contract.names import JOINTS, LEGS
from tcbi_sim.measurement import Commands, Measurement, Scenario

RIG, SOURCE = "hexapod", "driver"


def measure(
    robot: EmulatedRobot, scenario: Scenario, commands: Commands | Controller, *, trial: int = 0, policy_id: str = ""
) -> Measurement:
    """Run a scenario on the robot; `trial` numbers its repeats.

    Raises:
      EmulatedRobotError: commands of the wrong shape.
    """
    feed = Script(commands.time, commands.target, commands.ramp) if isinstance(commands, Commands) else commands
    initial = None if scenario.initial_joint_position is None else np.array(scenario.initial_joint_position)
    recording = robot.rollout(
        scene_of(scenario), scenario.duration, feed, initial=initial, settle=scenario.settle, trial=trial
    )
    rollout_id = f"emulated-{robot.specimen.seed}-{scenario.task}-{scenario.seed}-{trial}"
    return as_measurement(recording, scenario, rollout_id, policy_id)


def scene_of(scenario: Scenario) -> Scene:
    """What the experimenter sets up for a scenario."""
    blocks = tuple(Box(block.center, block.size, block.yaw) for block in scenario.blocks)
    return Scene(scenario.slope_roll, scenario.slope_pitch, blocks, scenario.initial_yaw)


def as_measurement(recording: Recording, scenario: Scenario, rollout_id: str, policy_id: str = "") -> Measurement:
    """The same arrays under the project's names."""
    return Measurement(
        rollout_id=rollout_id,
        rig=RIG,
        scenario=scenario,
        policy_id=policy_id,
        source=SOURCE,
        commands=Commands(recording.command_time, recording.command_target, recording.ramp),
        joint_names=JOINTS,
        foot_names=LEGS,
        time=recording.time,
        joint_position=recording.joint_position,
        attitude=recording.attitude,
        angular_velocity=recording.angular_velocity,
        linear_acceleration=recording.linear_acceleration,
        contact=recording.contact,
        position=recording.position,
        distance=recording.distance,
    )
