"""A measurement as the messages of the contract.

Floats go through unchanged. Times are rounded to the nanosecond, the grain of a stamp. What the contract has no word
for is written thus: a command given with the torque off carries `effort` zero beside its positions; a command that is
itself a torque (N m) carries `effort` and no positions.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tcbi_contract import names
from tcbi_infer.bags import schemas
from tcbi_infer.bags.note import write_note
from tcbi_sim.measurement import Measurement, Scenario

BEGIN, END, ABORT = 0, 1, 2
NOT_MEASURED = -1.0  # element 0 of an Imu covariance


def _type(name: str) -> Any:
    return schemas.typestore().types[name]


def stamp(nanoseconds: int) -> Any:
    sec, nanosec = divmod(int(nanoseconds), 1_000_000_000)
    return _type("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def header(nanoseconds: int, frame: str) -> Any:
    return _type("std_msgs/msg/Header")(stamp=stamp(nanoseconds), frame_id=frame)


def vector(values: Sequence[float] | np.ndarray) -> Any:
    x, y, z = (float(v) for v in values)
    return _type("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)


def event(
    nanoseconds: int,
    kind: int,
    rollout_id: str,
    scenario: Scenario,
    policy_id: str = "",
    source: str = "",
    distance: float = float("nan"),
    note: str = "",
) -> Any:
    """A `RolloutEvent` as a message of `rosbags`."""
    point = _type("geometry_msgs/msg/Point")
    blocks = [
        _type("tcbi_msgs/msg/Block")(
            center=point(*(float(v) for v in block.center)), size=vector(block.size), yaw=float(block.yaw)
        )
        for block in scenario.blocks
    ]
    return _type(schemas.MESSAGES[names.ROLLOUT_EVENT])(
        header=header(nanoseconds, ""),
        rollout_id=rollout_id,
        kind=kind,
        task=scenario.task,
        policy_id=policy_id,
        source=source,
        slope_roll=float(scenario.slope_roll),
        slope_pitch=float(scenario.slope_pitch),
        blocks=blocks,
        distance=float(distance),
        note=note,
    )


def joint_state(nanoseconds: int, joint_names: Sequence[str], position: np.ndarray) -> Any:
    none = np.empty(0)
    return _type(schemas.MESSAGES[names.JOINT_STATES])(
        header=header(nanoseconds, names.BASE_FRAME),
        name=list(joint_names),
        position=np.asarray(position, float),
        velocity=none,
        effort=none,
    )


def imu(
    nanoseconds: int, attitude: np.ndarray | None, angular_velocity: np.ndarray | None, acceleration: np.ndarray | None
) -> Any:
    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if attitude is None else (float(v) for v in attitude)
    zero = np.zeros(3)
    return _type(schemas.MESSAGES[names.IMU])(
        header=header(nanoseconds, names.IMU_FRAME),
        orientation=_type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w),
        orientation_covariance=_covariance(attitude is not None),
        angular_velocity=vector(zero if angular_velocity is None else angular_velocity),
        angular_velocity_covariance=_covariance(angular_velocity is not None),
        linear_acceleration=vector(zero if acceleration is None else acceleration),
        linear_acceleration_covariance=_covariance(acceleration is not None),
    )


def _covariance(measured: bool) -> np.ndarray:
    """Zeros say "unknown", as REP-145 has it; -1 in front says "not measured"."""
    covariance = np.zeros(9)
    covariance[0] = 0.0 if measured else NOT_MEASURED
    return covariance


def foot_contacts(nanoseconds: int, foot_names: Sequence[str], contact: np.ndarray) -> Any:
    return _type(schemas.MESSAGES[names.FOOT_CONTACTS])(
        header=header(nanoseconds, names.BASE_FRAME),
        name=list(foot_names),
        contact=np.asarray(contact, bool),
        force=np.empty(0, np.float32),
    )


def tracker_pose(nanoseconds: int, position: np.ndarray) -> Any:
    """A tracked position; its orientation is NaN, since none was measured."""
    x, y, z = (float(v) for v in position)
    nan = float("nan")
    pose = _type("geometry_msgs/msg/Pose")(
        position=_type("geometry_msgs/msg/Point")(x=x, y=y, z=z),
        orientation=_type("geometry_msgs/msg/Quaternion")(x=nan, y=nan, z=nan, w=nan),
    )
    return _type(schemas.MESSAGES[names.TRACKER_POSE])(header=header(nanoseconds, names.WORLD_FRAME), pose=pose)


def joint_command(
    nanoseconds: int, joint_names: Sequence[str], target: np.ndarray, ramp: float, torque_on: bool, is_torque: bool
) -> Any:
    none = np.empty(0)
    whole, part = divmod(round(ramp * 1e9), 1_000_000_000)
    effort = np.asarray(target, float) if is_torque else (none if torque_on else np.zeros(len(target)))
    point = _type("trajectory_msgs/msg/JointTrajectoryPoint")(
        positions=none if is_torque else np.asarray(target, float),
        velocities=none,
        accelerations=none,
        effort=effort,
        time_from_start=_type("builtin_interfaces/msg/Duration")(sec=whole, nanosec=part),
    )
    return _type(schemas.MESSAGES[names.JOINT_COMMANDS])(
        header=header(nanoseconds, names.BASE_FRAME), joint_names=list(joint_names), points=[point]
    )


def diagnostic(nanoseconds: int, values: Sequence[tuple[str, float]]) -> Any:
    """Readings as a driver tells them: one status, a key and a number each."""
    pair = _type("diagnostic_msgs/msg/KeyValue")
    status = _type("diagnostic_msgs/msg/DiagnosticStatus")(
        level=0,
        name="readings",
        message="as recorded",
        hardware_id="",
        values=[pair(key=key, value=repr(float(value))) for key, value in values],
    )
    return _type(schemas.MESSAGES[names.DIAGNOSTICS])(header=header(nanoseconds, ""), status=[status])


def nanoseconds(time: np.ndarray, start: int) -> list[int]:
    """Seconds of a rollout's clock as stamps, `start` being 0 s."""
    return [start + int(t) for t in np.rint(np.asarray(time, float) * 1e9)]


def messages(measurement: Measurement, start: int, torque_commands: bool = False) -> Iterator[tuple[str, int, bytes]]:
    """(relative topic, stamp in ns, CDR bytes) of a rollout, in the order of time.

    Args:
      start: stamp of BEGIN, ns.
      torque_commands: the targets are torques (N m).
    """
    rows = sorted(_rows(measurement, start, torque_commands), key=lambda row: row[1])
    for topic, time, message in rows:
        yield topic, time, schemas.encode(message, schemas.MESSAGES[topic])


def _rows(m: Measurement, start: int, torque_commands: bool) -> Iterator[tuple[str, int, Any]]:
    common = (m.rollout_id, m.scenario, m.policy_id, m.source)
    yield names.ROLLOUT_EVENT, start, event(start, BEGIN, *common, note=write_note(m.rig, m.scenario))
    for i, time in enumerate(nanoseconds(m.commands.time, start)):
        on = m.commands.torque_on is None or bool(m.commands.torque_on[i])
        command = joint_command(time, m.joint_names, m.commands.target[i], m.commands.ramp, on, torque_commands)
        yield names.JOINT_COMMANDS, time, command
    times = nanoseconds(m.time, start)
    inertial = (m.attitude, m.angular_velocity, m.linear_acceleration)
    for i, time in enumerate(times):
        yield names.JOINT_STATES, time, joint_state(time, m.joint_names, m.joint_position[i])
        if any(values is not None for values in inertial):
            yield names.IMU, time, imu(time, *(None if values is None else values[i] for values in inertial))
        if m.contact is not None:
            yield names.FOOT_CONTACTS, time, foot_contacts(time, m.foot_names, m.contact[i])
        if m.position is not None:
            yield names.TRACKER_POSE, time, tracker_pose(time, m.position[i])
    read: dict[int, list[tuple[str, float]]] = {}
    for key, (when, values) in m.readings.items():
        for time, value in zip(nanoseconds(when, start), values, strict=True):
            read.setdefault(time, []).append((key, value))
    for time, pairs in read.items():
        yield names.DIAGNOSTICS, time, diagnostic(time, pairs)
    end = max([start + round(m.scenario.duration * 1e9), *times[-1:]])
    yield names.ROLLOUT_EVENT, end, event(end, END, *common, distance=m.distance)
