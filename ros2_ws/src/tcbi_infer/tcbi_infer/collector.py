"""The action `collect_rollouts`: reset, BEGIN, policy on, wait, policy off, END, again and again; needs ROS.

It runs as a coroutine in the node's one thread; between steps it only asks whether something has come true. So nothing
blocks, and recording goes on meanwhile. Durations are ROS time; patience is wall time.
"""

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.serialization import serialize_message

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.collection import Request, as_it_is, check, next_tick, recorded, rollout_id, scenario_of
from tcbi_infer.collection_messages import begin_event, distance_between, request_of
from tcbi_infer.collector_services import (
    GROUND_AS_IT_IS,
    STATUS_S,
    CancelledError,
    Services,
    Until,
    refuse_if_cancelled,
)
from tcbi_infer.errors import RecordingError
from tcbi_msgs.action import CollectRollouts
from tcbi_msgs.msg import RolloutEvent

if TYPE_CHECKING:
    from tcbi_infer.recorder_node import RecorderNode

NO_POLICY = "none"
CLOCK_APART_S = 30.0  # between a reset's stamp and this node's clock: more means that they are different clocks
LEAD_NS = 300_000_000  # from the publication of BEGIN to its stamp, where time runs by itself
STARTS = 3  # of a rollout whose policy came too late on a busy machine, or never; the last one is taken as it is
FEEDBACK_S = 0.5  # wall time
COMMAND_SILENCE_S = 1.0  # ROS time, five control periods


class LateStartError(RecordingError):
    """The policy was switched on when its first tick had passed, so that no repeat would be like this rollout, or its
    sensors were silent just then, so that it sent no command at all.
    """


class Collector:
    """Runs one goal at a time for a recorder node."""

    def __init__(self, node: "RecorderNode") -> None:
        self.node = node
        self.busy = False
        self._rollout_id = ""
        self._ground_as_it_is = False  # in the present collection
        self._late_starts = 0  # in the present collection
        self._services = Services(node)

    def is_own(self, name: str) -> bool:
        """Whether this event is the collector's own, heard back."""
        return bool(self._rollout_id) and name == self._rollout_id

    def stop_policy(self) -> bool:
        """Ask the policy to rest, without waiting; False while there is none to ask."""
        if self.busy:
            return True  # the collection that runs decides
        return self._services.stop_policy() is not None

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
        self._ground_as_it_is, self._late_starts = False, 0
        self._services.expect_hands()
        await self._require_one_robot(goal)
        folder = self._folder(request)
        try:
            await self._policy(request)
            for index in range(request.number):
                bag = await self._rollout(goal, request, index, folder)
                bags.append(bag)
        finally:
            if folder is not self.node.folder:
                folder.close()
            if request.policy not in ("", NO_POLICY):
                await self._services.give_back()

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
        refuse_if_cancelled(goal)
        reset, placed = await self._services.reset_episode(goal, scenario, request.model)
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
                await self._services.set_policy(True)
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
            refuse_if_cancelled(goal)
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
            await self._services.set_policy(False)
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
        if request.policy != NO_POLICY and (future := self._services.stop_policy()) is not None:
            await Until(future.done, node.values.service_timeout_s)

    async def _distance(self, goal: Any, timeout_s: float) -> float:
        """From the tracker; else what the operator enters in time and before a cancelling; else unknown."""
        node = self.node
        if len(node.poses) > 1:
            return distance_between(node.poses[0], node.poses[-1])
        if timeout_s > 0:
            await Until(lambda: node.distance is not None or goal.is_cancel_requested, timeout_s)
        return math.nan if node.distance is None else node.distance

    async def _require_one_robot(self, goal: Any) -> None:
        """Two robots would be recorded as one. The middleware counts a node that was killed for a while longer."""

        def robots() -> int:
            return int(self.node.count_publishers(names.JOINT_STATES))

        if not await Until(lambda: robots() <= 1 or goal.is_cancel_requested, self.node.values.alone_timeout_s):
            raise RecordingError(
                f"{robots()} nodes publish {names.JOINT_STATES}, allowed is one: two graphs share this ROS_DOMAIN_ID; "
                "end one of them, or give it a namespace"
            )
        refuse_if_cancelled(goal)

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

    def _tell(self, goal: Any, done: int, number: int, remaining_s: float) -> None:
        feedback = CollectRollouts.Feedback()
        feedback.done, feedback.number = done, number
        feedback.rollout_id, feedback.remaining_s = self._rollout_id, remaining_s
        goal.publish_feedback(feedback)

    async def _policy(self, request: Request) -> None:
        """Have the wanted policy in use, off for now."""
        if request.policy == NO_POLICY:
            return
        await self._services.set_policy(False)
        if request.policy:
            await self._services.lend_to(request.policy)
        else:
            await Until(lambda: bool(self.node.policy_id), STATUS_S)

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
