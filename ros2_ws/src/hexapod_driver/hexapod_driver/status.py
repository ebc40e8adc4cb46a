"""The driver's health in words: what goes into `diagnostics` once a second. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from hexapod_driver import feetech
from hexapod_driver.calibration import Calibration
from hexapod_driver.link import Link
from hexapod_driver.readings import Health
from tcbi_contract.safety import Mode

OK, WARN, ERROR = 0, 1, 2  # levels of diagnostic_msgs/DiagnosticStatus
BEHIND_S = 0.05  # of a stamp: less is the jitter of the link
HOT_C = 65  # an STS servo protects itself at 70 degrees


@dataclass(frozen=True)
class Status:
    """One entry: level, a line, values by name."""

    name: str
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)


def statuses(link: Link, refused: int, last_refusal: str) -> list[Status]:
    """Link, servos and safety at this moment."""
    return [_link(link), _servos(link), _safety(link, refused, last_refusal)]


def graph(publishers: dict[str, int]) -> Status:
    """Whether somebody else speaks on topics that have one publisher each.

    Args:
      publishers: number of publishers by topic.
    """
    crowded = [f"{count} publishers on {topic}" for topic, count in publishers.items() if count > 1]
    if not crowded:
        return Status("graph", OK, "alone")
    return Status("graph", ERROR, f"{', '.join(crowded)}; two graphs share this ROS_DOMAIN_ID, end one of them")


def clock(behind_s: float) -> Status:
    """Whether stamps are those of the clock.

    Args:
      behind_s: by how much the newest stamps had to be raised so that none repeats or goes back.
    """
    values = {"stamps_raised_by_s": f"{behind_s:.3f}"}
    if behind_s < BEHIND_S:
        return Status("clock", OK, "stamps rise with the clock", values)
    remedy = "its times are false until reset_episode; leave the clock alone, then record again"
    return Status("clock", WARN, f"this computer's clock was set back by {behind_s:.2f} s; {remedy}", values)


def _link(link: Link) -> Status:
    robot = link.robot
    values = {"port": link.settings.port, "reconnects": str(link.reconnects)}
    if robot is None:
        return Status("link", ERROR, link.state, values)
    counters = robot.wire.counters
    values |= {
        "joint_readings": str(robot.health.joint_readings),
        "board_samples": str(robot.health.board_samples),
        "dropped_frames": str(counters.lost_samples),
        "damaged_frames": str(robot.wire.bad_frames),
        "late_replies": str(counters.late_replies),
        "incomplete_readings": str(robot.health.incomplete_reads),
        "skipped_questions": str(robot.health.skipped_questions),
        "limited_commands": str(robot.health.limited_commands),
        "clock_restarts": str(robot.wire.board_clock.restarts),
    }
    if link.identity is not None:
        values |= {"board": link.identity.name, "board_firmware": str(link.identity.firmware)}
    return Status("link", OK, link.state, values)


def _servos(link: Link) -> Status:
    robot = link.robot
    if robot is None:
        return Status("servos", ERROR, "not connected")
    health, calibration = robot.health, link.settings.calibration
    voltage, temperature = health.voltage, health.temperature  # one look: another thread replaces them
    faults = _servo_faults(health, temperature, calibration)
    values = {"voltage_V": f"{min(voltage.values()):.1f}"} if voltage else {}
    for name, joint in calibration.joints.items():
        if joint.servo in temperature:
            values[f"temperature_C/{name}"] = str(temperature[joint.servo])
    level = ERROR if health.silent_servos else WARN if faults else OK
    return Status("servos", level, "; ".join(faults) or f"all {len(calibration.joints)} servos answer", values)


def _servo_faults(health: Health, temperature: dict[int, int], calibration: Calibration) -> list[str]:
    names = {joint.servo: f"{name} (id {joint.servo})" for name, joint in calibration.joints.items()}
    faults = []
    if health.silent_servos:
        faults.append(f"no answer from {_listed(names, health.silent_servos)}")
    for servo, code in dict(health.errors).items():
        if code:
            faults.append(f"{names[servo]} reports {', '.join(feetech.error_names(code))}")
    hot = [servo for servo, degrees in temperature.items() if degrees >= HOT_C]
    if hot:
        faults.append(f"hot: {_listed(names, hot)}")
    return faults


def _listed(names: dict[int, str], servos: Sequence[int]) -> str:
    return ", ".join(names[s] for s in servos)


def _safety(link: Link, refused: int, last_refusal: str) -> Status:
    safety, unconfirmed = link.safety, _unconfirmed(link)
    mode = safety.mode
    level = ERROR if mode is Mode.STOPPED or unconfirmed else WARN if safety.needs_reset else OK
    message = mode.value if not safety.reason or safety.reason == mode.value else f"{mode.value}: {safety.reason}"
    if unconfirmed:
        message += f"; torque not confirmed to be off by {unconfirmed}"
    if safety.needs_reset:
        release = "call emergency_stop/release, then" if mode is Mode.STOPPED else "call"
        message += f"; {release} reset_episode to arm"
    values = {"mode": mode.value, "needs_reset": str(safety.needs_reset).lower(), "refused_commands": str(refused)}
    if unconfirmed:
        values["torque_unconfirmed"] = unconfirmed
    if last_refusal:
        values["last_refusal"] = last_refusal
    return Status("safety", level, message, values)


def _unconfirmed(link: Link) -> str:
    """Which servos of a limp robot have not said that their torque is off; empty where all have."""
    joints, robot = link.settings.calibration.joints, link.robot
    servos = tuple(joint.servo for joint in joints.values()) if robot is None else robot.health.unconfirmed
    if len(servos) == len(joints):
        return "any servo"
    return _listed({joint.servo: f"{name} (id {joint.servo})" for name, joint in joints.items()}, servos)
