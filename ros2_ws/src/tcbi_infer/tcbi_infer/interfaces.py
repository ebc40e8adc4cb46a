"""The Python classes of the topics that are recorded and replayed; needs ROS."""

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Imu, JointState
from trajectory_msgs.msg import JointTrajectory

from tcbi_contract import names
from tcbi_msgs.msg import FootContacts

STREAMS = {  # relative topic -> type; `rollout/event` has a QoS of its own
    names.JOINT_STATES: JointState,
    names.IMU: Imu,
    names.FOOT_CONTACTS: FootContacts,
    names.JOINT_COMMANDS: JointTrajectory,
    names.TRACKER_POSE: PoseStamped,
    names.DIAGNOSTICS: DiagnosticArray,
}
