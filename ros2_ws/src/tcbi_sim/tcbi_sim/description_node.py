"""Publishes the rig's URDF, latched, so that RViz and Foxglove draw the robot and its simulation alike."""

from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.node import Node
from std_msgs.msg import String

from tcbi_contract.messages import LATCHED_QOS
from tcbi_contract.names import ROBOT_DESCRIPTION
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
        self._publisher = self.create_publisher(String, ROBOT_DESCRIPTION, LATCHED_QOS)
        self._publisher.publish(String(data=text))
        self.get_logger().info(f"description of {values.rig}: {len(text)} characters")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("description_node", DescriptionNode, args)
