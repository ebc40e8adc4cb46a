"""Publishes the rig's URDF, latched, so that RViz and Foxglove draw the robot and its simulation alike."""

from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import String

from tcbi_contract import names
from tcbi_contract.messages import LATCHED_QOS, STREAM_QOS
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_sim.urdf import describe_rig


@dataclass(frozen=True)
class DescriptionParameters:
    """Parameters of the description node."""

    rig: str = parameter("hexapod", "rig whose URDF is published")


class DescriptionNode(Node):
    """Publishes `robot_description` once; late subscribers get it too."""

    def __init__(self) -> None:
        super().__init__("description_node")
        values = declare(self, DescriptionParameters)
        text = describe_rig(values.rig)
        self._publisher = self.create_publisher(String, names.ROBOT_DESCRIPTION, LATCHED_QOS)
        self._publisher.publish(String(data=text))
        self._health = DiagnosticStatus(level=DiagnosticStatus.OK, name="description_node", message="published")
        self._health.values = [KeyValue(key="rig", value=values.rig), KeyValue(key="characters", value=str(len(text)))]
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, STREAM_QOS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=steady)
        self.get_logger().info(f"description of {values.rig}: {len(text)} characters")

    def _diagnose(self) -> None:
        array = DiagnosticArray(status=[self._health])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("description_node", DescriptionNode, args)
