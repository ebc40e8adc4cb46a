"""QoS profiles and message layouts, so that driver and simulator publish the same by construction; needs ROS."""

import math
from array import array
from collections.abc import Iterable, Sequence

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tcbi_contract.names import BASE_FRAME, CONTROL_PERIOD_S, IMU_FRAME, JOINTS, LEGS, WORLD_FRAME
from tcbi_msgs.msg import FootContacts

STREAM_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=50,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

ABSENT = -1.0  # element 0 of an Imu covariance whose quantity was not measured


def seconds(stamp: Time) -> float:
    """A stamp as seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def nanoseconds(stamp: Time) -> int:
    """A stamp as nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def to_stamp(nanoseconds: int) -> Time:
    """Nanoseconds as a stamp."""
    sec, nanosec = divmod(int(nanoseconds), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def joint_state(stamp: Time, position: Iterable[float], names: Sequence[str] = JOINTS) -> JointState:
    """Measured joint positions (rad); the robot measures neither velocity nor effort."""
    message = JointState(name=list(names), position=array("d", position))
    message.header.stamp = stamp
    message.header.frame_id = BASE_FRAME
    return message


def imu(
    stamp: Time,
    orientation: Iterable[float] | None,
    angular_velocity: Iterable[float] | None,
    linear_acceleration: Iterable[float] | None,
    sd: tuple[float, float, float] = (0.01, 0.01, 0.1),
) -> Imu:
    """One IMU sample.

    Args:
      orientation: base in world, (x, y, z, w), or None if not measured.
      angular_velocity: rad/s in `imu_link`, or None.
      linear_acceleration: m/s^2 with gravity in `imu_link`, or None.
      sd: standard deviations of the three (rad, rad/s, m/s^2).
    """
    message = Imu()
    message.header.stamp = stamp
    message.header.frame_id = IMU_FRAME
    if orientation is not None:
        o = message.orientation
        o.x, o.y, o.z, o.w = (float(v) for v in orientation)
    for target, values in (
        (message.angular_velocity, angular_velocity),
        (message.linear_acceleration, linear_acceleration),
    ):
        if values is not None:
            target.x, target.y, target.z = (float(v) for v in values)
    message.orientation_covariance = _covariance(orientation, sd[0])
    message.angular_velocity_covariance = _covariance(angular_velocity, sd[1])
    message.linear_acceleration_covariance = _covariance(linear_acceleration, sd[2])
    return message


def _covariance(values: Iterable[float] | None, sd: float) -> list[float]:
    diagonal = ABSENT if values is None else sd * sd
    rest = 0.0 if values is None else diagonal
    return [diagonal, 0.0, 0.0, 0.0, rest, 0.0, 0.0, 0.0, rest]


def foot_contacts(
    stamp: Time, contact: Iterable[bool], force: Iterable[float] = (), names: Sequence[str] = LEGS
) -> FootContacts:
    """Foot switches; `force` (N) stays empty where the hardware has switches only."""
    message = FootContacts(name=list(names), contact=[bool(c) for c in contact], force=[float(f) for f in force])
    message.header.stamp = stamp
    message.header.frame_id = BASE_FRAME
    return message


def tracker_pose(stamp: Time, position: Iterable[float], orientation: Iterable[float]) -> PoseStamped:
    """Body pose in the world, position in m, orientation (x, y, z, w)."""
    message = PoseStamped()
    message.header.stamp = stamp
    message.header.frame_id = WORLD_FRAME
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = (float(v) for v in position)
    o.x, o.y, o.z, o.w = (float(v) for v in orientation)
    return message


def joint_command(
    stamp: Time, position: Iterable[float], duration_s: float = CONTROL_PERIOD_S, names: Sequence[str] = JOINTS
) -> JointTrajectory:
    """One command: reach `position` (rad) on a linear ramp within `duration_s`."""
    message = JointTrajectory(joint_names=list(names))
    message.header.stamp = stamp
    message.header.frame_id = BASE_FRAME
    point = JointTrajectoryPoint(positions=array("d", position))
    whole = math.floor(duration_s)
    point.time_from_start = Duration(sec=whole, nanosec=round((duration_s - whole) * 1e9))
    message.points = [point]
    return message
