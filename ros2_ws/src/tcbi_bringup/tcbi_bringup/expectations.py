"""What the contract says of each topic, for the table of `up` and for `doctor`."""

from dataclasses import dataclass

from tcbi_contract import names


@dataclass(frozen=True)
class Expectation:
    """One topic: its type, its rate (Hz, None for any), and who publishes it when.

    Attributes:
      always: it flows whenever a robot or a simulation is up; else only at times.
    """

    topic: str
    type_name: str
    rate_hz: float | None
    always: bool
    publisher: str


EXPECTATIONS = (
    Expectation(names.JOINT_STATES, "sensor_msgs/msg/JointState", names.SENSOR_RATE_HZ, True, "robot"),
    Expectation(names.IMU, "sensor_msgs/msg/Imu", names.SENSOR_RATE_HZ, True, "robot"),
    Expectation(names.FOOT_CONTACTS, "tcbi_msgs/msg/FootContacts", names.SENSOR_RATE_HZ, True, "robot"),
    Expectation(names.TRACKER_POSE, "geometry_msgs/msg/PoseStamped", None, False, "robot or tracker"),
    Expectation(
        names.JOINT_COMMANDS, "trajectory_msgs/msg/JointTrajectory", names.CONTROL_RATE_HZ, False, "policy_node"
    ),
    Expectation(names.DIAGNOSTICS, "diagnostic_msgs/msg/DiagnosticArray", None, True, "every node but page and replay"),
)
RATE_TOLERANCE = 0.15  # relative


def judge_rate(expected_hz: float, seen_hz: float) -> bool:
    """Whether a rate is what the contract says, within the tolerance."""
    return abs(seen_hz - expected_hz) <= RATE_TOLERANCE * expected_hz
