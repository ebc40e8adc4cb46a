"""What a collection asks of the other nodes: to reset and place the robot, to load a policy, to switch it on and off.

Coroutines of rclpy (needs ROS); patience is wall time.
"""

import math
import time
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any

from std_srvs.srv import SetBool

from tcbi_contract import names
from tcbi_contract.errors import TcbiError
from tcbi_infer.collection_messages import blocks_of
from tcbi_infer.errors import RecordingError
from tcbi_msgs.srv import LoadPolicy, ResetEpisode
from tcbi_sim.measurement import Scenario

if TYPE_CHECKING:
    from tcbi_infer.recorder_node import RecorderNode

GROUND_AS_IT_IS = "slopes that were not given count as level, and there are no blocks"
STATUS_S = 3.0  # wall time for the policy node to say what is loaded
HANDS_S = 2.0  # to discover whether somebody places the robot
HELD_S = 5.0  # wall time for which a robot surely holds a reset's posture: half of the driver's hold_after_reset_s
ASKED = 2  # times: the middleware drops the answer to a client that the service's end has not discovered yet
# a real robot may be connecting still, or have missed a reply: tried so often, so far apart, but at first at once where
# hands can free a leg
RESETS, PAUSE_S = 4, 1.5


class CancelledError(TcbiError):
    """The caller does not want the rest."""


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


class Services:
    """The services that the other nodes offer."""

    def __init__(self, node: "RecorderNode") -> None:
        self.node = node
        self._hands_s = HANDS_S  # in the present collection; 0 once nobody has come
        self._reset = node.create_client(ResetEpisode, names.RESET_EPISODE)
        self._place = node.create_client(ResetEpisode, names.PLACE_ROBOT)
        self._load = node.create_client(LoadPolicy, names.LOAD_POLICY)
        self._enable = node.create_client(SetBool, names.ENABLE_POLICY)

    def expect_hands(self) -> None:
        """A collection begins: somebody who places the robot may have come."""
        self._hands_s = HANDS_S

    def stop_policy(self) -> Any | None:
        """Ask the policy to rest, without waiting; the future of its answer, None while there is nobody to ask."""
        if not self._enable.service_is_ready():
            return None
        return self._enable.call_async(SetBool.Request(data=False))

    async def reset_episode(self, goal: Any, scenario: Scenario, model: str) -> tuple[Any, bool]:
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
        refuse_if_cancelled(goal)
        placed = _succeeded(future.result(), names.PLACE_ROBOT)
        if placed.stamp.sec or placed.stamp.nanosec:
            return placed.stamp
        return self.node.get_clock().now().to_msg()

    async def lend_to(self, policy: str) -> None:
        """Lend the robot to a policy until it is given back."""
        request = LoadPolicy.Request(policy=policy, lend=True)
        loaded = await self._call(self._load, request, names.LOAD_POLICY, "policy_node")
        await Until(lambda: bool(self.node.policy_id == loaded.policy_id), STATUS_S)
        self.node.policy_id = str(loaded.policy_id)  # its status may have been lost

    async def give_back(self) -> None:
        """Give the robot back to what was in use before, or its successor; not being able to is no fault."""
        if self._load.service_is_ready():
            future = self._load.call_async(LoadPolicy.Request(give_back=True))
            await Until(future.done, self.node.values.service_timeout_s)

    async def set_policy(self, on: bool) -> None:
        """Switch the policy on or off."""
        await self._call(self._enable, SetBool.Request(data=on), names.ENABLE_POLICY, "policy_node")

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


def refuse_if_cancelled(goal: Any) -> None:
    """Raise CancelledError where the caller does not want the rest."""
    if goal.is_cancel_requested:
        raise CancelledError("cancelled")


def _succeeded(response: Any, what: str) -> Any:
    if not response.success:
        raise RecordingError(f"{what} failed: {response.message}")
    return response
