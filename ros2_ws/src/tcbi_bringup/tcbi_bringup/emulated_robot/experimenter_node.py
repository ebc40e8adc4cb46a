"""The laboratory around an emulated robot: a tracker on `tracker/pose`, and hands on the service `place_robot`.

Where that service exists, a recorder calls it once `reset_episode` has brought the robot into its posture; where it
does not, a person tilts the ground. The answer comes when the robot has come to rest; its stamp is that of the rest.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.experimenter import ExperimenterClient, checked, default_socket_path
from tcbi_bringup.emulated_robot.mechanics import Box, Scene
from tcbi_contract.messages import STREAM_QOS, tracker_pose
from tcbi_contract.names import DIAGNOSTICS, DIAGNOSTICS_RATE_HZ, PLACE_ROBOT, TRACKER_POSE
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_msgs.srv import ResetEpisode


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node."""

    socket: str = parameter("", "the emulated robot's socket; empty for its default path")
    rate_hz: float = parameter(50.0, "poses a second", 1.0, 200.0)
    position_noise_m: float = parameter(0.001, "standard deviation of the tracker's position", 0.0, 1.0)
    orientation_noise_rad: float = parameter(0.002, "standard deviation of the tracker's orientation", 0.0, 1.0)
    settle_s: float = parameter(1.0, "how long a robot that was put down comes to rest, s", 0.0, 10.0)
    seed: int = parameter(0, "of the tracker's noise", 0)


class ExperimenterNode(Node):
    """Publishes what a tracker would see and does what a person's hands would do."""

    def __init__(self) -> None:
        super().__init__("experimenter_node")
        self.parameters = declare(self, Parameters)
        self._client = ExperimenterClient(Path(self.parameters.socket or default_socket_path()))
        self._rng = np.random.default_rng(self.parameters.seed)
        self._fault = ""  # why the robot is not seen
        self._placed = 0
        self._publisher = self.create_publisher(PoseStamped, TRACKER_POSE, STREAM_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, DIAGNOSTICS, STREAM_QOS)
        own_group = ReentrantCallbackGroup()  # waits inside its callback while the timers go on
        self.create_service(ResetEpisode, PLACE_ROBOT, self._place, callback_group=own_group)
        self.create_timer(1.0 / self.parameters.rate_hz, self._track)
        self.create_timer(1.0 / DIAGNOSTICS_RATE_HZ, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _now(self) -> Time:
        return self.get_clock().now().to_msg()

    def _track(self) -> None:
        try:
            _, position, orientation = self._client.pose()
        except EmulatedRobotError as error:
            self._fault = str(error)
            self.get_logger().warning(self._fault, throttle_duration_sec=5.0)
            return
        self._fault = ""
        position = position + self._rng.normal(0.0, self.parameters.position_noise_m, 3)
        w, x, y, z = self._shaken(orientation)
        self._publisher.publish(tracker_pose(self._now(), position, (x, y, z, w)))

    def _shaken(self, orientation: np.ndarray) -> np.ndarray:
        """(4,) w x y z, turned by a small random angle."""
        w, x, y, z = orientation
        p, q, r = self._rng.normal(0.0, self.parameters.orientation_noise_rad / 2, 3)
        turned = np.array(
            [w - p * x - q * y - r * z, x + p * w + r * y - q * z, y + q * w - r * x + p * z, z + r * w + q * x - p * y]
        )
        return turned / np.linalg.norm(turned)

    async def _rest(self) -> None:
        """Let the robot come to rest, while the tracker goes on."""
        rested = Future()
        timer = self.create_timer(max(self.parameters.settle_s, 1e-3), lambda: rested.done() or rested.set_result(None))
        await rested
        self.destroy_timer(timer)

    async def _place(self, request: ResetEpisode.Request, response: ResetEpisode.Response) -> ResetEpisode.Response:
        blocks = tuple(
            Box((b.center.x, b.center.y, b.center.z), (b.size.x, b.size.y, b.size.z), b.yaw) for b in request.blocks
        )
        response.source = "experimenter"
        try:
            self._client.place(checked(Scene(request.slope_roll, request.slope_pitch, blocks, request.yaw)))
        except EmulatedRobotError as error:
            response.success, response.message = False, str(error)
            return response
        self._placed += 1
        await self._rest()
        response.success, response.stamp = True, self._now()
        response.message = (
            f"ground tilted by roll {request.slope_roll:.3f} and pitch {request.slope_pitch:.3f} rad with "
            f"{len(blocks)} blocks; the robot stands at its origin in its present posture"
        )
        return response

    def _diagnose(self) -> None:
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="experimenter_node", message="sees the robot")
        if self._fault:
            status.level, status.message = DiagnosticStatus.ERROR, self._fault
        status.values = [KeyValue(key="robot placed", value=str(self._placed))]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._now()
        self._diagnostics.publish(array)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("experimenter_node", ExperimenterNode, args)


if __name__ == "__main__":
    sys.exit(main())
