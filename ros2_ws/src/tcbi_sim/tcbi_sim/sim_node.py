"""The simulated robot in the graph: the driver's topics and services, with physics instead of a serial port.

In real time it follows the wall clock; in lockstep it owns `/clock` and waits for every command (docs/sim_node.md).
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_contract.parameters import ParameterError, declare, parameter
from tcbi_contract.running import run
from tcbi_contract.safety import CommandRefused, check_age
from tcbi_msgs.msg import FootContacts, RolloutEvent
from tcbi_msgs.srv import LoadModel, ResetEpisode
from tcbi_sim.episode import first_scenario, requested_scenario
from tcbi_sim.live import LiveSimulation, Reading
from tcbi_sim.lockstep import SECOND, WINDOW, LockstepClock
from tcbi_sim.measurement import Scenario
from tcbi_sim.messages import read_command, sim_diagnostics
from tcbi_sim.model import Model
from tcbi_sim.pacing import Pacer
from tcbi_sim.prompt_acks import ask_for_prompt_acks
from tcbi_sim.store import ModelStore

PERIOD = round(SECOND / names.SENSOR_RATE_HZ)
REPEAT_S = 0.5  # wall time
LISTENERS_S = 1.0  # wall time that lockstep waits for a listener that does not take in samples


@dataclass(frozen=True)
class SimParameters:
    """Parameters of the sim node."""

    mode: str = parameter("realtime", "follow the wall clock, or wait for commands", choices=("realtime", "lockstep"))
    model: str = parameter("latest", "model version to simulate; latest is the newest in the store")
    store: str = parameter("", "folder of the model versions; empty for ~/.local/share/tcbi")
    draw: bool = parameter(False, "take physical parameters from the model's distribution by the seed, not its mean")
    task: str = parameter("", "task whose terrain is there at the start; empty for flat ground")
    seed: int = parameter(0, "of terrain, noise and draw at the start; a reset brings its own", low=0)
    timestep: float = parameter(0.002, "of the physics, s; must divide 0.02", low=0.0005, high=0.01)
    noise: bool = parameter(True, "give the sensors the rig's noise and encoder steps")
    tracker: bool = parameter(True, "publish tracker/pose")
    lockstep_timeout_s: float = parameter(4.0, "wall time that an episode waits for a command", low=0.05, high=600.0)


class SimNode(Node):
    """Publishes what the robot would publish; single-threaded."""

    def __init__(self) -> None:
        super().__init__("sim_node")
        self.values = declare(self, SimParameters)
        self.store = ModelStore(self.values.store or None)
        scenario = first_scenario(self.values.task, self.values.seed)
        v = self.values
        model = self.store.load(v.model, "hexapod")
        self.live = LiveSimulation(model, scenario, timestep=v.timestep, noise=v.noise, draw=v.draw)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._in_episode = False
        self._last_stamp_s = 0.0
        self._published = 0
        self._unheard = 0  # samples published in lockstep since every listener was known to have them
        self._present: tuple[int, Reading] | None = None  # the last sample, with its stamp in ns
        self._listeners = 0  # that it was published to
        self._offer()
        if v.mode == "lockstep":
            self._start_lockstep()
        else:
            self._start_realtime()
        self.get_logger().info(f"simulating {model.version} in {v.mode} mode")

    # -- the graph ------------------------------------------------------------------------------------------------

    def _offer(self) -> None:
        stream = messages.STREAM_QOS
        self._joints = self.create_publisher(JointState, names.JOINT_STATES, stream)
        self._imu = self.create_publisher(Imu, names.IMU, stream)
        self._contacts = self.create_publisher(FootContacts, names.FOOT_CONTACTS, stream)
        self._tracker = self.create_publisher(PoseStamped, names.TRACKER_POSE, stream) if self.values.tracker else None
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, stream)
        # commands before events: a policy's last command is then read before the END that follows it
        self.create_subscription(JointTrajectory, names.JOINT_COMMANDS, self._on_command, stream)
        self.create_subscription(RolloutEvent, names.ROLLOUT_EVENT, self._on_event, messages.LATCHED_QOS)
        self.create_service(ResetEpisode, names.RESET_EPISODE, self._on_reset)
        self.create_service(LoadModel, names.LOAD_MODEL, self._on_load_model)
        self.create_service(Trigger, names.EMERGENCY_STOP, self._on_stop)
        self.create_service(Trigger, names.RELEASE_EMERGENCY_STOP, self._on_release)

    def _publish(self, stamp_ns: int, reading: Reading) -> None:
        stamp = messages.to_stamp(stamp_ns)
        self._joints.publish(messages.joint_state(stamp, reading.joint_position))
        gyro, force = reading.angular_velocity, reading.linear_acceleration
        self._imu.publish(messages.imu(stamp, reading.orientation, gyro, force))
        self._contacts.publish(messages.foot_contacts(stamp, reading.contact))
        if self._tracker:
            self._tracker.publish(messages.tracker_pose(stamp, reading.position, reading.facing))
        self._present = stamp_ns, reading
        self._published += 1

    def _count_listeners(self) -> int:
        streams = (self._joints, self._imu, self._contacts, self._tracker)
        return sum(p.get_subscription_count() for p in streams if p is not None)

    def _diagnose(self, note: str = "") -> None:
        if self.count_publishers(names.JOINT_STATES) > 1:
            note = note or f"another node publishes {names.JOINT_STATES} too: two graphs run in one ROS domain"
        facts: dict[str, object] = {"mode": self.values.mode, "samples": self._published, "rollout": self._in_episode}
        if self.clock:
            facts |= {"commands missed": self.clock.missed, "commands of another time": self.clock.strays}
        else:
            facts |= {"clock jumps": self.pacer.slips}
        self._diagnostics.publish(sim_diagnostics(messages.to_stamp(self._now()), self.live, facts, note))

    # -- real time ------------------------------------------------------------------------------------------------

    def _start_realtime(self) -> None:
        if self.get_parameter("use_sim_time").value:
            raise ParameterError("use_sim_time is true, but mode realtime publishes no /clock; use mode lockstep")
        self.clock: LockstepClock | None = None
        self.pacer = Pacer(PERIOD)
        self.pacer.restart(time.monotonic_ns(), self._ros_now())
        self.create_timer(PERIOD / SECOND, self._on_period, clock=self._steady)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose, clock=self._steady)

    def _ros_now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_period(self) -> None:
        for _ in range(self.pacer.due(time.monotonic_ns(), self._ros_now())):
            stamp = self.pacer.next_stamp()
            for reading in self.live.advance(1):
                self._publish(stamp, reading)

    # -- lockstep -------------------------------------------------------------------------------------------------

    def _start_lockstep(self) -> None:
        self.clock = LockstepClock(self.values.lockstep_timeout_s)
        self._clock_publisher = self.create_publisher(ClockMessage, names.CLOCK, messages.STREAM_QOS)
        self._publish_clock()
        self.create_timer(min(0.1, self.values.lockstep_timeout_s / 4), self._watch, clock=self._steady)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._diagnose_while_waiting, clock=self._steady)

    def _publish_clock(self) -> None:
        assert self.clock is not None
        self._clock_told = time.monotonic()
        self._clock_publisher.publish(ClockMessage(clock=messages.to_stamp(self.clock.now)))

    def _run_window(self) -> None:
        assert self.clock is not None
        start = self.clock.now
        self._wait_for_listeners()
        self._listeners = self._count_listeners()
        for k, reading in enumerate(self.live.advance(WINDOW // PERIOD), start=1):
            self._publish(start + k * PERIOD, reading)
        self._unheard += WINDOW // PERIOD
        self.clock.advance(time.monotonic())
        if self.clock.now % SECOND == 0:
            self._diagnose()
        self._publish_clock()

    def _wait_for_listeners(self) -> None:
        """Let a slow listener catch up before the publishers' queues run over: a clock that waits loses nothing."""
        if self._unheard + WINDOW // PERIOD <= messages.STREAM_QOS.depth:
            return
        patience = Duration(seconds=LISTENERS_S)
        streams = (self._joints, self._imu, self._contacts, self._tracker)
        if not all([p.wait_for_all_acked(patience) for p in streams if p is not None]):
            self._diagnose(f"a listener took in nothing for {LISTENERS_S:g} s: it may have lost samples")
        self._unheard = 0

    def _watch(self) -> None:
        assert self.clock is not None
        if self.clock.overdue(time.monotonic()):
            self.clock.skip()
            self._run_window()
            self._diagnose(f"no command within {self.values.lockstep_timeout_s} s of wall time; the last one is held")
        elif time.monotonic() - self._clock_told > REPEAT_S:
            self._repeat()

    def _diagnose_while_waiting(self) -> None:
        """Between rollouts the clock may stand for ever; a rollout's own diagnostics come by its own time alone."""
        if not self._in_episode:
            self._diagnose()

    def _repeat(self) -> None:
        """The present once more, for listeners discovered since: a policy without the first sample never acts.

        A rollout under way repeats its clock alone, so that no recording has a sample twice.
        """
        listeners = self._count_listeners()
        if self._present and listeners > self._listeners:
            stamp, reading = self._present
            if not self._in_episode:
                self._publish(stamp, reading)
        self._listeners = listeners
        self._publish_clock()

    # -- callbacks ------------------------------------------------------------------------------------------------

    def _now(self) -> int:
        return self.clock.now if self.clock else self._ros_now()

    def _on_command(self, message: JointTrajectory) -> None:
        stamp_s = messages.seconds(message.header.stamp)
        later = 0.0 if self.clock else self.pacer.since_last(time.monotonic_ns())
        try:
            target, duration_s = read_command(message)
            check_age(stamp_s, self._now() / SECOND, self._last_stamp_s)
            self.live.command(target, duration_s, later)
            self._last_stamp_s = max(stamp_s, self._last_stamp_s)
        except CommandRefused as error:
            self.live.refuse(str(error))
            self.get_logger().warning(str(error), throttle_duration_sec=2.0)
        if self.clock and self.clock.may_run(messages.nanoseconds(message.header.stamp) or self.clock.now):
            self._run_window()

    def _on_event(self, event: RolloutEvent) -> None:
        begins = event.kind == RolloutEvent.BEGIN
        if self.clock and begins:
            begins = self.clock.begin(messages.nanoseconds(event.header.stamp), time.monotonic())
        elif self.clock:
            self.clock.end()
        self._in_episode = begins

    def _on_reset(self, request: ResetEpisode.Request, response: ResetEpisode.Response) -> ResetEpisode.Response:
        response.source = "sim"
        try:
            scenario = requested_scenario(request)
            model = self.store.load(request.model, "hexapod") if request.model else None
            response.stamp = self._restart(scenario, model)
        except TcbiError as error:
            response.message = str(error)
            return response
        response.success, response.message = True, f"{scenario.task or 'flat ground'} on {self.live.model.version}"
        return response

    def _restart(self, scenario: Scenario, model: Model | None) -> Time:
        reading = self.live.reset(scenario, model)
        self._in_episode, self._last_stamp_s = False, 0.0
        if self.clock:
            duration = None if math.isinf(scenario.duration) else round(scenario.duration * SECOND)
            stamp = self.clock.reset(duration, time.monotonic())
        else:
            stamp = self.pacer.restart(time.monotonic_ns(), self._ros_now())
        self._listeners = self._count_listeners()
        self._publish(stamp, reading)
        if self.clock:
            self._publish_clock()
        return messages.to_stamp(stamp)

    def _on_load_model(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        response.model = self.live.model.version
        if self._in_episode:
            response.message = "a rollout is running; load the model after its END"
            return response
        try:
            self._restart(self.live.scenario, self.store.load(request.model or "latest", "hexapod"))
        except TcbiError as error:
            response.message = str(error)
            return response
        response.success, response.model = True, self.live.model.version
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.live.stop()
        response.success, response.message = True, "torque is off; call emergency_stop/release, then reset_episode"
        return response

    def _on_release(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        stood = self.live.release()
        response.success = True
        response.message = "released; limp until reset_episode" if stood else "no emergency stop stood"
        return response


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    ask_for_prompt_acks()
    return run("sim_node", SimNode, args)
