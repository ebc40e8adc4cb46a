"""The policy in the graph: sensor data in, joint commands out, 5 times a second of ROS time.

When it acts stands in `ticker.py`. It starts disabled (`policy/enable`), swaps policies while it runs (`policy/load`),
and stops the motion when sensor data are late or missing: it then publishes no more commands, so that the robot goes
limp after two control periods of silence, and acts again only after the next `policy/enable`.
"""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import LoadPolicy
from tcbi_policy.artefact import Actor, Policy, find_policy, keep_policy
from tcbi_policy.errors import PolicyReplaced
from tcbi_policy.ticker import SensorLoss, Tick, Ticker
from tcbi_sim.measurement import observation, roll_pitch_yaw
from tcbi_sim.store import default_root

SETTLE_S = 0.02  # before the first tick: what was sent before `policy/enable` may still be in the queues
WATCH_S = 0.05
DISCOVERY_S = 8.0  # from the node's start, in which a robot that is there is heard


@dataclass(frozen=True)
class PolicyParameters:
    """Parameters of the policy node."""

    policy: str = parameter("gait:stand", "gait:<name>, a policy's name, or the path of a .safetensors file")
    store: str = parameter("", "folder of the store; empty for ~/.local/share/tcbi")
    enabled: bool = parameter(False, "act from the start, without a call of policy/enable")
    sensor_timeout_s: float = parameter(0.4, "wall time of silence after which the motion stops", low=0.1, high=60.0)


class PolicyNode(Node):
    """Runs one policy; single-threaded, and files are read beside the ticks."""

    def __init__(self) -> None:
        super().__init__("policy_node")
        self.values = declare(self, PolicyParameters)
        self._store = Path(self.values.store).expanduser() if self.values.store else default_root()
        self._actor: Actor = self._find(self.values.policy)
        self._actor.reset(1)
        self._lender: Actor | None = None  # gets the robot back after a recording
        self._ticker = Ticker(bool(self.get_parameter("use_sim_time").value), self.values.sensor_timeout_s)
        self._yaw = 0.0  # rad at the first tick
        self._swapped_at: float | None = None  # s since the first tick
        self._fault = ""
        self._quiet_until = 0.0
        self._worst_s = 0.0  # longest computation of a tick since the last diagnostics
        self._began, self._unanswered = time.monotonic(), list[Future]()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._offer()
        if self.values.enabled:
            self._enable()
        self.get_logger().info(f"policy {self._actor.policy_id}")

    def _offer(self) -> None:
        stream, latched = messages.STREAM_QOS, messages.LATCHED_QOS
        self._commands = self.create_publisher(JointTrajectory, names.JOINT_COMMANDS, stream)
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, stream)
        self._status = self.create_publisher(String, names.POLICY_STATUS, latched)
        self.create_subscription(RolloutEvent, names.ROLLOUT_EVENT, self._on_event, latched)
        self.create_subscription(Imu, names.IMU, self._on_imu, stream)
        self.create_subscription(JointState, names.JOINT_STATES, self._on_joints, stream)
        # a group of its own: an answer may wait until the sensors are heard
        asking = MutuallyExclusiveCallbackGroup()
        self.create_service(SetBool, names.ENABLE_POLICY, self._on_enable, callback_group=asking)
        # a group of its own: while this one awaits a file, the callbacks of the others go on
        loading = MutuallyExclusiveCallbackGroup()
        self.create_service(LoadPolicy, names.LOAD_POLICY, self._on_load, callback_group=loading)
        self.create_timer(WATCH_S, self._watch, clock=self._steady)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=self._steady)
        self._first_tick = self.create_timer(SETTLE_S, self._after_enabling, clock=self._steady, autostart=False)
        self._tell()

    def _tell(self) -> None:
        self._status.publish(String(data=self._actor.policy_id))

    # -- sensors --------------------------------------------------------------------------------------------------

    def _on_joints(self, message: JointState) -> None:
        by_name = dict(zip(message.name, message.position, strict=False))
        missing = [joint for joint in names.JOINTS if joint not in by_name]
        if missing:
            self._stop(f"joint_states lacks {', '.join(missing)}")
            return
        position = np.array([by_name[joint] for joint in names.JOINTS])
        if not np.isfinite(position).all():
            self._stop("joint_states holds values that are not finite")
            return
        self._ticker.add_joints(messages.nanoseconds(message.header.stamp), position, time.monotonic())
        self._act()

    def _on_imu(self, message: Imu) -> None:
        q = message.orientation
        attitude = np.array([q.w, q.x, q.y, q.z])
        norm = float(np.linalg.norm(attitude))
        if message.orientation_covariance[0] == messages.ABSENT or not 0.5 < norm < 2.0:
            return  # no orientation; the ticks that need one will say so
        self._ticker.add_attitude(messages.nanoseconds(message.header.stamp), attitude / norm, time.monotonic())
        self._act()

    def _on_event(self, event: RolloutEvent) -> None:
        if event.kind == RolloutEvent.BEGIN:
            self._ticker.not_before(messages.nanoseconds(event.header.stamp))

    # -- acting ---------------------------------------------------------------------------------------------------

    def _act(self) -> None:
        """Act if a tick is due."""
        if time.monotonic() < self._quiet_until:
            return
        try:
            tick = self._ticker.due(self._actor.needs_attitude)
        except SensorLoss as error:  # the ticker is off by then
            self._say_stopped(str(error))
            return
        if tick is not None:
            self._command(tick)

    def _command(self, tick: Tick) -> None:
        began = time.monotonic()
        attitude = np.array([1.0, 0.0, 0.0, 0.0]) if tick.attitude is None else tick.attitude
        if tick.elapsed == 0.0:
            self._yaw = float(roll_pitch_yaw(attitude)[2])
            self._swapped_at = None
            self._actor.reset(1)
        start = self._swapped_at or 0.0
        seen = observation(tick.joint_position, attitude, self._yaw)
        target = self._actor.act(tick.elapsed - start, seen[None])[0]
        self._commands.publish(messages.joint_command(messages.to_stamp(tick.time), target))
        self._worst_s = max(self._worst_s, time.monotonic() - began)

    def _stop(self, reason: str) -> None:
        """No more commands until the next `policy/enable`; the robot goes limp by itself."""
        if self._ticker.enabled:
            self._ticker.disable()
            self._say_stopped(reason)

    def _say_stopped(self, reason: str) -> None:
        self._fault = reason
        self.get_logger().error(f"motion stopped: {reason}; call policy/enable to go on")
        self._diagnose()

    def _watch(self) -> None:
        reason = self._ticker.silence(self._actor.needs_attitude, time.monotonic())
        if reason:
            self._stop(reason)
        if self._ready():
            for answer in self._unanswered:
                answer.set_result(None)
            self._unanswered.clear()

    def _ready(self) -> bool:
        """Whether the sensors have been heard, or there has been time enough to discover them."""
        return self._ticker.heard(self._actor.needs_attitude) or time.monotonic() - self._began > DISCOVERY_S

    # -- services -------------------------------------------------------------------------------------------------

    def _enable(self) -> None:
        now = time.monotonic()
        self._fault = ""
        self._quiet_until = now + SETTLE_S
        self._ticker.enable(now)
        self._first_tick.reset()

    def _after_enabling(self) -> None:
        if not self._commands.get_subscription_count():  # not discovered yet: a command now would be lost
            self._quiet_until = time.monotonic() + SETTLE_S
            return
        self._first_tick.cancel()
        self._quiet_until = 0.0
        self._act()

    async def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Act, or rest. Who has it rest before a rollout is answered once a rollout could begin."""
        if request.data and not self._ticker.enabled:
            self._enable()
        elif not request.data:
            self._ticker.disable()
            self._fault = ""
            if not self._ready():
                self._unanswered.append(Future(executor=self.executor))
                self._unanswered[-1].add_done_callback(lambda _: None)  # wakes the executor
                await self._unanswered[-1]
        response.success = True
        response.message = f"{self._actor.policy_id} {'acts' if request.data else 'rests'}"
        return response

    async def _on_load(self, request: LoadPolicy.Request, response: LoadPolicy.Response) -> LoadPolicy.Response:
        """Swap the policy between two ticks, lend the robot or take it back; an empty request only asks who has it."""
        try:
            actor = await self._read(request.policy) if request.policy else None
            self._hand_over(actor, request)
            response.success, response.message = True, f"policy {self._actor.policy_id}"
        except TcbiError as error:
            response.message = str(error)
        response.policy_id = self._actor.policy_id
        response.lender = self._lender.policy_id if self._lender else ""
        return response

    def _hand_over(self, actor: Actor | None, request: LoadPolicy.Request) -> None:
        """Do what was asked for, with the policy that was read for it.

        Raises:
          PolicyReplaced: it was to take the place of a policy that has no place by now.
        """
        lender = self._lender
        if request.give_back:
            self._lender = None
            if lender:
                self._swap(lender)
        elif actor is not None and request.replaces:
            standing = lender or self._actor
            if standing.policy_id != request.replaces:
                raise PolicyReplaced(f"{standing.policy_id} came into use meanwhile, in place of {request.replaces}")
            if lender:
                self._lender = actor
            else:
                self._swap(actor)
        elif actor is not None:
            self._lender = (lender or self._actor) if request.lend else None
            self._swap(actor)

    def _read(self, reference: str) -> Future:
        """Read and check a policy in a thread, so that no tick waits for a disk."""
        future: Future = Future(executor=self.executor)
        future.add_done_callback(lambda _: None)  # wakes the executor, which then resumes whoever awaits

        def read() -> None:
            try:
                future.set_result(self._find(reference))
            except TcbiError as error:
                future.set_exception(error)
            except Exception as error:  # noqa: BLE001 - whoever awaits must be answered, or no other load ever begins
                future.set_exception(TcbiError(f"policy {reference}: {type(error).__name__}: {error}"))

        threading.Thread(target=read, daemon=True).start()
        return future

    def _find(self, reference: str) -> Actor:
        """The policy behind a reference; one of a file is kept where trainings find it."""
        actor = find_policy(reference, self._store)
        if isinstance(actor, Policy):
            try:
                keep_policy(actor, self._store)
            except OSError as error:
                self.get_logger().warning(f"{actor.policy_id} is not kept, no training starts from it: {error}")
        return actor

    def _swap(self, actor: Actor) -> None:
        actor.reset(1)
        self._swapped_at = self._ticker.elapsed() if self._ticker.enabled else None
        self._actor = actor
        self._tell()
        self.get_logger().info(f"policy {actor.policy_id}")

    # -- health ---------------------------------------------------------------------------------------------------

    def _diagnose(self) -> None:
        status = DiagnosticStatus(name="policy_node", hardware_id=self._actor.policy_id)
        if self._fault:
            status.level, status.message = DiagnosticStatus.ERROR, f"stopped: {self._fault}"
        elif self._ticker.enabled:
            status.level, status.message = DiagnosticStatus.OK, "acting"
        else:
            status.level, status.message = DiagnosticStatus.OK, "resting"
        facts = {
            "policy": self._actor.policy_id,
            "ticks": self._ticker.ticks,
            "ticks missed": self._ticker.missed,
            "longest tick (ms)": f"{1e3 * self._worst_s:.2f}",
        }
        self._worst_s = 0.0
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("policy_node", PolicyNode, args)
