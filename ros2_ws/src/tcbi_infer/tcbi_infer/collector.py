"""The action `collect_rollouts`: reset, BEGIN, policy on, wait, policy off, END, again and again; needs ROS.

It runs as a coroutine in the node's one thread; between steps it only asks whether something has come true. So nothing
blocks, and recording goes on meanwhile. Durations are ROS time; patience is wall time.
"""

import math
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.serialization import serialize_message
from std_srvs.srv import SetBool

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.collection import Request, as_it_is, check, next_tick, recorded, rollout_id, scenario_of
from tcbi_infer.collection_messages import begin_event, blocks_of, distance_between, request_of
from tcbi_infer.errors import RecordingError
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import LoadPolicy, ResetEpisode
from tcbi_sim.measurement import Scenario

if TYPE_CHECKING:
    from tcbi_infer.recorder_node import RecorderNode

NO_POLICY = "none"
GROUND_AS_IT_IS = "slopes that were not given count as level, and there are no blocks"
CLOCK_APART_S = 30.0  # between a reset's stamp and this node's clock: more means that they are different clocks
LEAD_NS = 300_000_000  # from the publication of BEGIN to its stamp, where time runs by itself
STARTS = 3  # of a rollout whose policy came too late on a busy machine, or never; the last one is taken as it is
STATUS_S = 3.0  # wall time for the policy node to say what is loaded
FEEDBACK_S = 0.5  # wall time
COMMAND_SILENCE_S = 1.0  # ROS time, five control periods
HANDS_S = 2.0  # to discover whether somebody places the robot
HELD_S = 5.0  # wall time for which a robot surely holds a reset's posture: half of the driver's hold_after_reset_s
ASKED = 2  # times: the middleware drops the answer to a client that the service's end has not discovered yet
# a real robot may be connecting still, or have missed a reply: tried so often, so far apart, but at first at once where
# hands can free a leg
RESETS, PAUSE_S = 4, 1.5


class CancelledError(TcbiError):
    """The caller does not want the rest."""


class LateStartError(RecordingError):
    """The policy was switched on when its first tick had passed, so that no repeat would be like this rollout, or its
    sensors were silent just then, so that it sent no command at all.
    """


class Until:
    """Wait in a coroutine of rclpy until a condition holds or the wall time is over; tells whether it holds."""

    def __init__(self, condition: Callable[[], bool], timeout_s: float = math.inf) -> None:
        self._condition, self._deadline = condition, time.monotonic() + timeout_s

    def __await__(self) -> Generator[None, None, bool]:
        while not self._condition():
            if time.monotonic() > self._deadline:
                return False
            yield
        return True


class Collector:
    """Runs one goal at a time for a recorder node."""

    def __init__(self, node: "RecorderNode") -> None:
        self.node = node
        self.busy = False
        self._rollout_id = ""
        self._hands_s = HANDS_S  # in the present collection; 0 once nobody has come
        self._ground_as_it_is = False  # in the present collection
        self._late_starts = 0  # in the present collection
        self._reset = node.create_client(ResetEpisode, names.RESET_EPISODE)
        self._place = node.create_client(ResetEpisode, names.PLACE_ROBOT)
        self._load = node.create_client(LoadPolicy, names.LOAD_POLICY)
        self._enable = node.create_client(SetBool, names.ENABLE_POLICY)

    def is_own(self, name: str) -> bool:
        """Whether this event is the collector's own, heard back."""
        return bool(self._rollout_id) and name == self._rollout_id

    def stop_policy(self) -> bool:
        """Ask the policy to rest, without waiting; False while there is none to ask."""
        if self.busy:
            return True  # the collection that runs decides
        if not self._enable.service_is_ready():
            return False
        self._enable.call_async(SetBool.Request(data=False))
        return True

    async def run(self, goal: Any) -> Any:
        """Serve one goal, and answer whatever happens."""
        result = CollectRollouts.Result()
        bags: list[Path] = []
        try:
            await self._collect(goal, bags)
            as_found = f"; nobody offers {names.PLACE_ROBOT}: {GROUND_AS_IT_IS}" if self._ground_as_it_is else ""
            late = f"; in {self._late_starts} the policy came too late for its first tick" if self._late_starts else ""
            result.success, result.message = True, f"{recorded(len(bags))}{late}{as_found}"
            goal.succeed()
        except CancelledError as error:
            result.message = str(error)
            goal.canceled()
        except TcbiError as error:
            result.message = " ".join(str(error).split())
            self.node.get_logger().error(result.message)
            goal.abort()
        finally:
            self.busy = False
        result.bags = [str(bag.resolve()) for bag in bags]
        return result

    async def _collect(self, goal: Any, bags: list[Path]) -> None:
        request = request_of(goal.request)
        check(request)
        self._ground_as_it_is, self._late_starts, self._hands_s = False, 0, HANDS_S
        folder = self._folder(request)
        before, policy_id = self.node.policy_id, ""
        try:
            policy_id = await self._policy(request)
            for index in range(request.number):
                bag = await self._rollout(goal, request, index, folder)
                bags.append(bag)
        finally:
            if folder is not self.node.folder:
                folder.close()
            if before and policy_id not in ("", before) and self.node.policy_id == policy_id:
                await self._give_back(before)  # unless a training has put a better one in its place meanwhile

    def _folder(self, request: Request) -> RecordingFolder:
        own = self.node.folder
        if not request.folder or Path(request.folder).expanduser().resolve() == own.path.resolve():
            return own
        folder = RecordingFolder(request.folder)
        for line in folder.repaired:
            self.node.get_logger().warning(line)
        return folder

    # -- one rollout ----------------------------------------------------------------------------------------------

    async def _rollout(self, goal: Any, request: Request, index: int, folder: RecordingFolder) -> Path:
        for started in range(1, STARTS):
            try:
                return await self._start(goal, request, index, folder)
            except LateStartError as error:
                self.node.get_logger().warning(f"{error} ({started} of {STARTS} starts); it begins anew")
        return await self._start(goal, request, index, folder, last=True)

    async def _start(
        self, goal: Any, request: Request, index: int, folder: RecordingFolder, last: bool = False
    ) -> Path:
        """Reset, record, end. The last start keeps a rollout whose policy comes too late, and says so in its END."""
        scenario = scenario_of(request, index)
        self._refuse_if_cancelled(goal)
        reset, placed = await self._reset_episode(goal, scenario, request.model)
        if not placed:
            self._ground_as_it_is, scenario = True, as_it_is(request, scenario)
        begin = self._begin(reset.stamp)
        event = begin_event(rollout_id(request, index), scenario, self._acting(request), reset.source, begin)
        self._rollout_id = event.rollout_id
        end = begin + round(scenario.duration * 1e9)
        self.node.open(folder, event.rollout_id, begin, serialize_message(event), end)
        self._require_recording()
        self.node.events.publish(event)
        self.node.heard_joints_s = time.monotonic()
        late = ""
        try:
            if request.policy != NO_POLICY:
                await self._set_policy(True)
                late = self._late(begin)
                if late and not last:
                    raise LateStartError(late)
            await self._act(goal, request, index, end, last)
            return await self._end(goal, event, end, request, late)
        except LateStartError as error:
            self.node.recorder.discard()
            await self._abort(event, str(error), request)
            raise
        except TcbiError as error:
            await self._abort(event, str(error), request)
            raise

    async def _act(self, goal: Any, request: Request, index: int, end: int, last: bool) -> None:
        """Wait for the end, policy off."""
        node = self.node
        told = 0.0
        while True:
            left = (end - node.get_clock().now().nanoseconds) * 1e-9
            if left <= 0:
                break
            self._refuse_if_cancelled(goal)
            self._require_recording()
            if time.monotonic() - node.heard_joints_s > node.values.silence_timeout_s:
                raise RecordingError(
                    f"no {names.JOINT_STATES} for {node.values.silence_timeout_s:g} s; is the robot's node "
                    "(sim_node or driver_node) still running?"
                )
            if request.policy != NO_POLICY:
                node.fetch()  # simulated time may have run on for long since the last time
                self._require_commands(last)
            if time.monotonic() - told > FEEDBACK_S:
                told = time.monotonic()
                self._tell(goal, index, request.number, left)
            await Until(lambda: node.get_clock().now().nanoseconds >= end, 0.05)
        if request.policy != NO_POLICY:
            await self._set_policy(False)
        node.takes_distance = True
        self._tell(goal, index, request.number, 0.0)

    def _acting(self, request: Request) -> str:
        """The policy in use: a training may have put another in its place since the collection began."""
        return "" if request.policy == NO_POLICY else self.node.policy_id

    async def _end(self, goal: Any, event: RolloutEvent, end: int, request: Request, late: str) -> Path:
        node = self.node
        node.recorder.end(end, time.monotonic())
        await Until(lambda: node.recorder.rollout is None or node.recorder.settled(time.monotonic()))
        self._require_recording()
        event.kind, event.note, event.policy_id = RolloutEvent.END, late, self._acting(request)
        if late:
            node.get_logger().warning(f"{event.rollout_id}: {late}; no repeat will be like it")
            self._late_starts += 1
        event.header.stamp = messages.to_stamp(end)
        event.distance = await self._distance(goal, request.distance_timeout_s or node.values.distance_timeout_s)
        bag = node.close(event, end)
        if bag is None:
            raise RecordingError(node.fault)
        node.events.publish(event)
        return bag

    async def _abort(self, event: RolloutEvent, why: str, request: Request) -> None:
        node = self.node
        now = max(node.get_clock().now().nanoseconds, messages.nanoseconds(event.header.stamp))
        event.kind, event.note, event.distance = RolloutEvent.ABORT, " ".join(why.split()), math.nan
        event.header.stamp = messages.to_stamp(now)
        node.events.publish(event)
        if node.recorder.rollout is not None:
            node.close(event, now)
        if request.policy != NO_POLICY and self._enable.service_is_ready():
            future = self._enable.call_async(SetBool.Request(data=False))
            await Until(future.done, node.values.service_timeout_s)

    async def _distance(self, goal: Any, timeout_s: float) -> float:
        """From the tracker; else what the operator enters in time and before a cancelling; else unknown."""
        node = self.node
        if len(node.poses) > 1:
            return distance_between(node.poses[0], node.poses[-1])
        if timeout_s > 0:
            await Until(lambda: node.distance is not None or goal.is_cancel_requested, timeout_s)
        return math.nan if node.distance is None else node.distance

    def _require_recording(self) -> None:
        if self.node.recorder.rollout is None:
            raise RecordingError(self.node.fault or "the rollout is no longer recorded")

    def _require_commands(self, last: bool) -> None:
        """A policy that has stopped leaves the robot limp: what comes then is no rollout of it."""
        silent = 1e-9 * (self.node.get_clock().now().nanoseconds - self.node.commanded_ns)
        if silent > COMMAND_SILENCE_S:
            never = not self.node.commanded and not last
            raise (LateStartError if never else RecordingError)(
                f"the policy has sent no {names.JOINT_COMMANDS} for {silent:.1f} s and the robot is limp; the log of "
                "policy_node says why"
            )

    def _late(self, begin: int) -> str:
        """By how much the policy came too late for its first tick, in words; "" if it did not."""
        late = self.node.get_clock().now().nanoseconds - begin
        if late <= 0 or self.node.simulated_time:
            return ""
        return f"the policy was switched on {late * 1e-6:.0f} ms after the rollout had begun"

    def _refuse_if_cancelled(self, goal: Any) -> None:
        if goal.is_cancel_requested:
            raise CancelledError("cancelled")

    def _tell(self, goal: Any, done: int, number: int, remaining_s: float) -> None:
        feedback = CollectRollouts.Feedback()
        feedback.done, feedback.number = done, number
        feedback.rollout_id, feedback.remaining_s = self._rollout_id, remaining_s
        goal.publish_feedback(feedback)

    # -- the other nodes ------------------------------------------------------------------------------------------

    async def _call(self, client: Any, request: Any, what: str, who: str) -> Any:
        return _succeeded(await self._answer(client, request, what, who), what)

    async def _answer(self, client: Any, request: Any, what: str, who: str) -> Any:
        timeout_s = self.node.values.service_timeout_s
        if not await Until(client.service_is_ready, timeout_s):
            raise RecordingError(f"nobody offers {what} after {timeout_s:g} s; start {who}")
        for _ in range(ASKED):
            future = client.call_async(request)
            if await Until(future.done, timeout_s / ASKED):
                return future.result()
            client.remove_pending_request(future)  # the answer to the last request counts, for it is carried out last
        raise RecordingError(f"{what} was not answered within {timeout_s:g} s; look at the log of {who}")

    async def _reset_episode(self, goal: Any, scenario: Scenario, model: str) -> tuple[Any, bool]:
        """The answer to a reset, and whether ground and heading are the scenario's now."""
        request = ResetEpisode.Request(
            task=scenario.task,
            slope_roll=scenario.slope_roll,
            slope_pitch=scenario.slope_pitch,
            blocks=blocks_of(scenario),
            yaw=scenario.initial_yaw,
            joint_position=list(scenario.initial_joint_position or ()),
            seed=scenario.seed,
            model=model,
            duration=scenario.duration,
        )
        reset = await self._into_posture(goal, request)
        if reset.source == "sim":
            return reset, True
        reached = time.monotonic()
        stamp = await self._placed(goal, request)
        if stamp is None:
            return reset, False
        if time.monotonic() - reached > HELD_S:  # it may have gone limp meanwhile
            return await self._into_posture(goal, request), True
        reset.stamp = stamp
        return reset, True

    async def _into_posture(self, goal: Any, request: Any) -> Any:
        """The answer to a reset that has succeeded; a robot that fails it is tried again."""
        for tried in range(RESETS - 1):
            response = await self._answer(self._reset, request, names.RESET_EPISODE, "sim_node or driver_node")
            if response.success or response.source == "sim":
                return _succeeded(response, names.RESET_EPISODE)
            self.node.get_logger().warning(f"the robot is not ready ({response.message}); it is tried again")
            hands = self._place.service_is_ready()
            if tried or not hands:
                await Until(lambda: False, PAUSE_S)
            if hands:  # that lift the robot free its legs
                await self._placed(goal, request)
        return await self._call(self._reset, request, names.RESET_EPISODE, "sim_node or driver_node")

    async def _placed(self, goal: Any, request: Any) -> Any | None:
        """Have the ground set, which a robot cannot do itself; the stamp when it was, None if nobody is there."""
        if not await Until(self._place.service_is_ready, self._hands_s):
            self._hands_s = 0.0  # nobody is there; do not wait again
            self.node.get_logger().warning(f"nobody offers {names.PLACE_ROBOT}: {GROUND_AS_IT_IS}")
            return None
        future, timeout_s = self._place.call_async(request), self.node.values.place_timeout_s
        if not await Until(lambda: future.done() or goal.is_cancel_requested, timeout_s):
            raise RecordingError(f"{names.PLACE_ROBOT} was not answered within {timeout_s:g} s")
        self._refuse_if_cancelled(goal)
        placed = _succeeded(future.result(), names.PLACE_ROBOT)
        if placed.stamp.sec or placed.stamp.nanosec:
            return placed.stamp
        return self.node.get_clock().now().to_msg()

    async def _policy(self, request: Request) -> str:
        """Load the wanted policy, off for now; returns the name of the one that will act."""
        if request.policy == NO_POLICY:
            return ""
        await self._set_policy(False)
        if not request.policy:
            await Until(lambda: bool(self.node.policy_id), STATUS_S)
            return self.node.policy_id
        loaded = await self._call(
            self._load, LoadPolicy.Request(policy=request.policy), names.LOAD_POLICY, "policy_node"
        )
        await Until(lambda: bool(self.node.policy_id == loaded.policy_id), STATUS_S)
        self.node.policy_id = str(loaded.policy_id)  # its status may have been lost
        return self.node.policy_id

    async def _give_back(self, policy_id: str) -> None:
        """Load what was in use before, so that a training still starts from it; not being able to is no fault."""
        if self._load.service_is_ready():
            future = self._load.call_async(LoadPolicy.Request(policy=policy_id))
            await Until(future.done, self.node.values.service_timeout_s)

    async def _set_policy(self, on: bool) -> None:
        await self._call(self._enable, SetBool.Request(data=on), names.ENABLE_POLICY, "policy_node")

    def _zero(self, stamp: Any) -> int:
        """The rollout's zero (ns): the stamp of the first sample after the reset."""
        told = messages.nanoseconds(stamp)
        now = self.node.get_clock().now().nanoseconds
        if not told:
            return int(now)
        apart = abs(told - now) * 1e-9
        if apart > CLOCK_APART_S:
            raise RecordingError(
                f"the robot's clock and the recorder's are {apart:.0f} s apart; start both with the same use_sim_time"
            )
        return int(told)

    def _begin(self, stamp: Any) -> int:
        """When the rollout begins (ns).

        A simulation's clock stands at the reset. A robot's does not: there the rollout begins at a control tick a
        moment ahead, which leaves time to switch the policy on: every repeat has its commands at the same times.
        """
        zero = self._zero(stamp)
        if self.node.simulated_time:
            return zero
        return next_tick(max(zero, self.node.get_clock().now().nanoseconds + LEAD_NS))


def _succeeded(response: Any, what: str) -> Any:
    if not response.success:
        raise RecordingError(f"{what} failed: {response.message}")
    return response
