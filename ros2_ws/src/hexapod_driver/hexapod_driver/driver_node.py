"""The robot as ROS topics: joints, IMU and feet at 50 Hz out, commands in, with an emergency stop.

Everything about the robot is in `link` and below; this file converts messages. The tracker's pose is not here, since
the robot does not measure it.
"""

import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hexapod_driver import calibration, status
from hexapod_driver.clock import RisingStamps
from hexapod_driver.link import Link, LinkSettings
from hexapod_driver.messages import command, diagnostics, not_settable, posture
from hexapod_driver.posture import REST_S, PostureGoal
from hexapod_driver.readings import BoardReading, JointReading, Reading
from hexapod_driver.robot import Done, Robot
from hexapod_driver.serial_port import BAUD_RATE, SENSOR_BAUD_RATE
from tcbi_contract import messages, names, safety
from tcbi_contract.errors import TcbiError
from tcbi_contract.parameters import ParameterError, declare, parameter
from tcbi_contract.running import run
from tcbi_contract.safety import CommandRefused
from tcbi_msgs.msg import FootContacts
from tcbi_msgs.srv import ResetEpisode

SOURCE = "driver"


@dataclass(frozen=True)
class DriverParameters:
    """What a user may set."""

    port: str = parameter(
        "", "serial port of the robot, e.g. /dev/rfcomm0: the sensor board, or the servo bus of two ports"
    )
    baud_rate: int = parameter(BAUD_RATE, "of port, bit/s", 9_600, 4_000_000)
    sensor_port: str = parameter("", "the sensor board's own port; empty where everything goes over port")
    sensor_baud_rate: int = parameter(SENSOR_BAUD_RATE, "of sensor_port, bit/s", 9_600, 4_000_000)
    calibration: str = parameter("", "the robot's calibration file (TOML); empty for the shipped default")
    max_speed: float = parameter(4.5, "greatest speed of a commanded ramp, rad/s", 0.1, 10.0)
    approach_speed: float = parameter(0.8, "speed from a limp robot to the commands, and of resets, rad/s", 0.05, 2.0)
    command_timeout_s: float = parameter(0.4, "torque goes off after this long without a command, s", 0.25, 0.4)
    hold_after_reset_s: float = parameter(10.0, "how long a reset's posture waits for the first command, s", 0.4, 60.0)
    posture_tolerance: float = parameter(0.35, "how far a joint may rest from a reset's posture, rad", 0.01, 1.0)
    posture_rest_s: float = parameter(REST_S, "how long the joints rest before a reset is done, s", 0.1, 3.0)
    needs_reset: bool = parameter(False, "refuse commands until reset_episode; the launcher sets it after a crash")

    def link_settings(self) -> LinkSettings:
        """The part that concerns the link; raises CalibrationError."""
        limits = safety.Limits(
            max_speed=self.max_speed,
            approach_speed=self.approach_speed,
            silence_s=self.command_timeout_s,
            hold_s=self.hold_after_reset_s,
        )
        robot = calibration.load(self.calibration)
        return LinkSettings(self.port, self.baud_rate, self.sensor_port, self.sensor_baud_rate, robot, limits)


class DriverNode(Node):
    """Publishes what the robot measures and hands commands to it.

    Raises:
      TcbiError: a parameter, the calibration, the port or the robot is not as it should be.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("driver_node", **options)
        self.parameters = declare(self, DriverParameters)
        if not self.parameters.port:
            raise ParameterError("parameter 'port': got '', allowed is a serial port, e.g. -p port:=/dev/rfcomm0")
        if self.get_parameter("use_sim_time").value:
            raise ParameterError("parameter 'use_sim_time': got true, allowed is false; a robot's time is real")
        self._inbox: deque[Callable[[], None]] = deque()
        self._guard = self.create_guard_condition(self._work)
        self._joint_stamps, self._board_stamps = RisingStamps(), RisingStamps()
        self._last_stamp = 0
        self._newest_command_s = 0.0
        self._refused, self._last_refusal = 0, ""
        self._make_publishers()
        self.link = Link(self.parameters.link_settings(), self._take, self._now, self.get_logger().warning)
        if self.parameters.needs_reset:
            self.link.safety.go_limp("the driver crashed and was started again", needs_reset=True)
        self._make_inputs()
        self.link.connect()
        self.link.start()
        self.get_logger().info(f"robot on {self.parameters.port} is ready and limp")

    def leave(self) -> None:
        """Torque off, port closed."""
        self.link.close()

    def destroy_node(self) -> None:
        """Never without torque off."""
        self.leave()
        super().destroy_node()

    def _make_publishers(self) -> None:
        qos = messages.STREAM_QOS
        self._joint_states = self.create_publisher(messages.JointState, names.JOINT_STATES, qos)
        self._imu = self.create_publisher(messages.Imu, names.IMU, qos)
        self._foot_contacts = self.create_publisher(FootContacts, names.FOOT_CONTACTS, qos)
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos)

    def _make_inputs(self) -> None:
        self.create_subscription(JointTrajectory, names.JOINT_COMMANDS, self._on_command, messages.STREAM_QOS)
        # the answers come over the guard condition, which must be free to run while these wait for them
        waiting = ReentrantCallbackGroup()
        self.create_service(Trigger, names.EMERGENCY_STOP, self._on_stop, callback_group=waiting)
        self.create_service(Trigger, names.RELEASE_EMERGENCY_STOP, self._on_release, callback_group=waiting)
        self.create_service(ResetEpisode, names.RESET_EPISODE, self._on_reset, callback_group=waiting)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose)

    # From the link's thread to this one

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds

    def _take(self, reading: Reading) -> None:
        self._later(lambda: self._publish(reading))

    def _later(self, work: Callable[[], None]) -> None:
        self._inbox.append(work)
        self._guard.trigger()

    def _work(self) -> None:
        while self._inbox:
            self._inbox.popleft()()

    def _ask(self, start: Callable[[Done], None]) -> Future:
        """A future of (success, text) that the link's thread answers."""
        future: Future = Future()
        start(lambda success, text: self._later(lambda: future.set_result((success, text))))
        return future

    # Out

    def _publish(self, reading: Reading) -> None:
        if isinstance(reading, JointReading):
            self._last_stamp = self._joint_stamps.next(reading.stamp_ns)
            self._joint_states.publish(messages.joint_state(messages.to_stamp(self._last_stamp), reading.position))
        else:
            self._publish_board(reading)

    def _publish_board(self, reading: BoardReading) -> None:
        stamp = messages.to_stamp(self._board_stamps.next(reading.stamp_ns))
        sample = reading.sample
        measured = (sample.orientation, sample.angular_velocity, sample.linear_acceleration)
        if any(values is not None for values in measured):
            self._imu.publish(messages.imu(stamp, *measured))
        if sample.contact is not None:
            self._foot_contacts.publish(messages.foot_contacts(stamp, sample.contact))

    def _diagnose(self) -> None:
        if not self.link.alive:
            raise TcbiError("the link's thread has ended by a fault of the driver; its traceback stands above")
        entries = status.statuses(self.link, self._refused, self._last_refusal)
        entries.append(status.clock(1e-9 * max(self._joint_stamps.behind_ns, self._board_stamps.behind_ns)))
        topics = (names.JOINT_STATES, names.JOINT_COMMANDS)
        entries.append(status.graph({topic: self.count_publishers(topic) for topic in topics}))
        board = self.link.identity.name if self.link.identity else ""
        self._diagnostics.publish(diagnostics(self.get_clock().now().to_msg(), self.get_name(), board, entries))

    # In

    def _on_command(self, message: JointTrajectory) -> None:
        try:
            target, duration = command(message)
            stamp = messages.seconds(message.header.stamp)
            safety.check_age(stamp, 1e-9 * self._now(), self._newest_command_s)
        except CommandRefused as error:
            self._refuse(str(error))
            return
        self._newest_command_s = max(self._newest_command_s, stamp)
        self.link.post(
            lambda robot: robot.command(target, duration), lambda text: self._later(lambda: self._refuse(text))
        )

    def _refuse(self, text: str) -> None:
        self._refused += 1
        self._last_refusal = text
        self.get_logger().warning(text, throttle_duration_sec=2.0)

    async def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = await self._ask(self.link.emergency_stop)
        return response

    async def _on_release(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = await self._ask(self.link.release)
        return response

    async def _on_reset(self, request: ResetEpisode.Request, response: ResetEpisode.Response) -> ResetEpisode.Response:
        response.source = SOURCE
        values = self.parameters
        try:
            goal = PostureGoal(tuple(posture(request)), values.posture_tolerance, values.posture_rest_s)
        except CommandRefused as error:
            response.success, response.message = False, str(error)
            return response

        def start(done: Done) -> None:
            def begin(robot: Robot) -> None:
                robot.begin_posture(goal, done)

            self.link.post(begin, lambda text: done(False, text))

        success, text = await self._ask(start)
        response.success, response.message = success, text + not_settable(request)
        if success:
            self._newest_command_s = 0.0
            self._joint_stamps.restart()
            self._board_stamps.restart()
        response.stamp = self.get_clock().now().to_msg()
        return response


def main(args: list[str] | None = None) -> int:
    """Run the node until Ctrl-C; exit status 1 with one line where it cannot start."""
    return run("driver_node", DriverNode, args)


if __name__ == "__main__":
    sys.exit(main())
