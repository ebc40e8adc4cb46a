"""From ROS messages to plain values and back, for the driver node; needs ROS."""

from collections.abc import Iterable

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from trajectory_msgs.msg import JointTrajectory

from hexapod_driver.status import Status
from tcbi_contract import names
from tcbi_contract.safety import CommandRefused, ordered_target
from tcbi_contract.wording import counted
from tcbi_msgs.srv import ResetEpisode


def command(message: JointTrajectory) -> tuple[tuple[float, ...], float]:
    """Target (18,) rad in the contract's order, and the ramp's duration in s.

    Raises:
      CommandRefused: not one point, wrong names, or numbers that are not finite.
    """
    if len(message.points) != 1:
        raise CommandRefused(f"joint_commands: got {len(message.points)} points, allowed is 1")
    point = message.points[0]
    target = ordered_target(message.joint_names, point.positions)
    return target, point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec


def diagnostics(stamp: Time, node: str, hardware: str, entries: Iterable[Status]) -> DiagnosticArray:
    """One diagnostics message."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    message.status = [
        DiagnosticStatus(
            level=bytes((entry.level,)),
            name=f"{node}: {entry.name}",
            message=entry.message,
            hardware_id=hardware,
            values=[KeyValue(key=key, value=value) for key, value in entry.values.items()],
        )
        for entry in entries
    ]
    return message


def posture(request: ResetEpisode.Request) -> tuple[float, ...]:
    """The posture that a reset asks for, (18,) rad in the contract's order.

    Raises:
      CommandRefused: it is not 18 finite numbers inside the joint range.
    """
    if not len(request.joint_position):
        return (0.0,) * len(names.JOINTS)
    if len(request.joint_position) != len(names.JOINTS):
        raise CommandRefused(
            f"reset: joint_position has {len(request.joint_position)} values, allowed is {len(names.JOINTS)} or none"
        )
    target = ordered_target(names.JOINTS, request.joint_position)
    wrong = [f"{n}={p:.3f}" for n, p in zip(names.JOINTS, target, strict=True) if abs(p) > names.JOINT_LIMIT + 1e-6]
    if wrong:
        raise CommandRefused(
            f"reset: joint_position {', '.join(wrong)}, allowed is {names.JOINT_LIMIT:.4f} rad either side"
        )
    return target


def not_settable(request: ResetEpisode.Request) -> str:
    """What was asked for that hands have to do, in words."""
    wishes = []
    if request.slope_roll or request.slope_pitch:
        wishes.append(f"slope roll {request.slope_roll:.3f}, pitch {request.slope_pitch:.3f} rad")
    if request.yaw:
        wishes.append(f"heading {request.yaw:.3f} rad")
    if request.blocks:
        wishes.append(f"{counted(len(request.blocks), 'block')}")
    if request.model:
        wishes.append(f"model {request.model}")
    return f"; not set by the driver: {', '.join(wishes)}" if wishes else ""
