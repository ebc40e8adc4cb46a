"""When the policy acts, and on which samples: driven by the stamps of the sensor data alone.

Ticks lie on the multiples of 0.2 s of ROS time. The tick at time t is due as soon as joint angles (and the attitude,
if the policy needs it) with a stamp of t or later have arrived, and takes the values at t between the samples at its
sides. So the same stamps give the same commands, live at any speed, in lockstep and in a replay; nothing here knows ROS
or looks at a clock but the steady one, for silence.

    ticker = Ticker(sim_time=False, timeout_s=0.4)
    ticker.enable(wall)
    ticker.add_joints(stamp_ns, position, wall)
    ticker.add_attitude(stamp_ns, quaternion, wall)
    tick = ticker.due(needs_attitude=True)        # a Tick, or None
    reason = ticker.silence(True, wall)           # why the motion must stop, or ""

Late or missing data stop the motion: `due` raises `SensorLoss`, and nothing is due until the next `enable`. A
simulation that is reset starts the ticks anew; in simulated time that is known from a gap by where the stamps go on.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_policy.errors import PolicyError

SECOND = 1_000_000_000  # ns
PERIOD = round(CONTROL_PERIOD_S * SECOND)
MAX_AGE = PERIOD // 2  # ns, of a sample at its tick
DEPTH = 64


class SensorLoss(PolicyError):
    """Sensor data came late, or not at all, while the policy was enabled."""


@dataclass(frozen=True)
class Tick:
    """One action to take."""

    time: int  # ns of ROS time, a multiple of the control period
    elapsed: float  # s since the first tick after enabling
    joint_position: np.ndarray  # (J,) rad
    attitude: np.ndarray | None  # (4,) w x y z


class Stream:
    """The newest samples of one sensor."""

    def __init__(self, name: str, unit: bool = False):
        self.name = name
        self._unit = unit  # of unit quaternions
        self.arrived: float | None = None  # steady s of the last arrival
        self._samples: deque[tuple[int, np.ndarray]] = deque(maxlen=DEPTH)

    @property
    def newest(self) -> int | None:
        """Stamp (ns) of the newest sample."""
        return self._samples[-1][0] if self._samples else None

    def add(self, stamp: int, values: np.ndarray, wall: float) -> None:
        """Keep a sample; one that is not newer than the last is dropped."""
        self.arrived = wall
        if self.newest is None or stamp > self.newest:
            self._samples.append((stamp, values))

    def at(self, time: int) -> np.ndarray | None:
        """The values at a time, between the samples at its sides; where these are far apart, those of the older.

        None where there is none in the tenth of a second before.
        """
        behind: tuple[int, np.ndarray] | None = None
        for stamp, values in reversed(self._samples):
            if stamp > time:
                behind = stamp, values
            elif stamp < time - MAX_AGE:
                break
            elif stamp == time or behind is None or behind[0] - stamp > MAX_AGE:
                return values
            else:
                return _between(values, behind[1], (time - stamp) / (behind[0] - stamp), self._unit)
        return None

    def age(self, time: int) -> str:
        """How old the newest sample at a time is, in words."""
        stamps = [stamp for stamp, _ in self._samples if stamp <= time]
        return f"{(time - stamps[-1]) / 1e6:.0f} ms old" if stamps else "absent"

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()


class Ticker:
    """The ticks of one policy node.

    Attributes:
      enabled: whether ticks may come due.
      ticks: since the node started.
      missed: ticks that were skipped because the node or its data were more than a whole period behind.
    """

    def __init__(self, sim_time: bool, timeout_s: float):
        self.enabled = False
        self.ticks = 0
        self.missed = 0
        self._sim_time = sim_time
        self._timeout = timeout_s
        self._joints, self._attitude = Stream("joint_states"), Stream("imu/data", unit=True)
        self._earliest = 0
        self._first: int | None = None
        self._next: int | None = None
        self._enabled_at = 0.0

    def enable(self, wall: float) -> None:
        """Start: the first tick is at the newest joint sample if it lies on the grid, else at the next multiple."""
        if not self._sim_time:  # a simulated clock may stand still, and then its last samples are still the present
            for stream in (self._joints, self._attitude):
                if stream.arrived is not None and wall - stream.arrived > self._timeout:
                    stream.clear()
        self.enabled, self._first, self._next, self._enabled_at = True, None, None, wall
        self._earliest = max(self._earliest, _grid_up(self._joints.newest or 0))

    def disable(self) -> None:
        """Stop."""
        self.enabled = False
        self._earliest = 0

    def not_before(self, stamp: int) -> None:
        """A rollout begins at this stamp: no tick before it."""
        self._earliest = _grid_up(stamp)
        if self._next is not None and self._next < self._earliest:
            self._first = self._next = None

    def add_joints(self, stamp: int, position: np.ndarray, wall: float) -> None:
        """Joint angles (J,) in rad arrived."""
        self._follow_jump(self._joints, stamp)
        self._joints.add(stamp, position, wall)

    def add_attitude(self, stamp: int, attitude: np.ndarray, wall: float) -> None:
        """An attitude (4,) w x y z arrived."""
        if self._attitude.newest is not None and stamp < self._attitude.newest - PERIOD:
            self._attitude.clear()
        self._attitude.add(stamp, attitude, wall)

    def _follow_jump(self, stream: Stream, stamp: int) -> None:
        """Start over where the clock was set back, or where a simulation was reset (its clock then jumps forward).

        What jumps forward in another way while ticks may come due is a gap, of which the coming tick tells.
        """
        if stream.newest is None:
            return
        back = stamp < stream.newest - PERIOD
        ahead = self._sim_time and stamp > stream.newest + MAX_AGE
        if back or (ahead and (not self.enabled or _reset_follows(stream.newest, stamp))):
            stream.clear()
            self._first = self._next = None
            self._earliest = _grid_up(stamp)

    def due(self, needs_attitude: bool) -> Tick | None:
        """The tick to act on now, if there is one.

        Raises:
          SensorLoss: it is due, but its data are missing; the ticker is then disabled.
        """
        if not self.enabled or self._joints.newest is None:
            return None
        if self._next is None:
            return self._first_tick(needs_attitude)
        if self._joints.newest < self._next:
            return None
        behind = (self._joints.newest - self._next) // PERIOD
        time = self._next + behind * PERIOD
        if needs_attitude and self._waits_for_attitude(time):
            return None
        if self._sim_time:  # no silence tells of a gap that ends at a tick
            for skipped in range(self._next, time, PERIOD):
                self._require(skipped, needs_attitude)
        self.missed += behind
        return self._tick(time, needs_attitude)

    def elapsed(self) -> float | None:
        """Seconds from the first tick to the coming one; None before the first."""
        return None if self._next is None or self._first is None else (self._next - self._first) / 1e9

    def _waits_for_attitude(self, time: int) -> bool:
        assert self._joints.newest is not None
        return (self._attitude.newest or 0) < time and self._joints.newest < time + MAX_AGE

    def _first_tick(self, needs_attitude: bool) -> Tick | None:
        assert self._joints.newest is not None
        newest = min(self._joints.newest, self._attitude.newest or 0) if needs_attitude else self._joints.newest
        time = newest // PERIOD * PERIOD
        if time < self._earliest or self._joints.at(time) is None:
            return None
        if needs_attitude and self._attitude.at(time) is None:
            return None
        self._first = time
        return self._tick(time, needs_attitude)

    def _require(self, time: int, needs_attitude: bool) -> None:
        for stream in (self._joints, self._attitude)[: 2 if needs_attitude else 1]:
            if stream.at(time) is None:
                age = stream.age(time)
                self.disable()
                raise SensorLoss(
                    f"{stream.name} is {age} at a control tick, at most {MAX_AGE / 1e6:.0f} ms are allowed"
                )

    def _tick(self, time: int, needs_attitude: bool) -> Tick:
        self._require(time, needs_attitude)
        self._next = time + PERIOD
        self.ticks += 1
        position = self._joints.at(time)
        assert position is not None and self._first is not None
        return Tick(time, (time - self._first) / 1e9, position, self._attitude.at(time))

    def heard(self, needs_attitude: bool) -> bool:
        """Whether each sensor that is needed has been heard at all."""
        return all(s.arrived is not None for s in (self._joints, self._attitude)[: 2 if needs_attitude else 1])

    def silence(self, needs_attitude: bool, wall: float) -> str:
        """Why the motion must stop although nothing arrived, or "".

        A simulated clock may stand still, so that silence of all sensors means nothing there; but joint angles without
        an attitude do.
        """
        if not self.enabled:
            return ""
        quiet = [s for s in (self._joints, self._attitude)[: 2 if needs_attitude else 1] if self._quiet(s, wall)]
        if not quiet or (self._sim_time and self._joints in quiet):
            return ""
        if self._sim_time and not self._stuck_on_attitude():
            return ""
        return " and ".join(s.name for s in quiet) + f" silent for more than {self._timeout:g} s"

    def _quiet(self, stream: Stream, wall: float) -> bool:
        return wall - max(stream.arrived or 0.0, self._enabled_at) > self._timeout

    def _stuck_on_attitude(self) -> bool:
        return self._joints.newest is not None and (self._attitude.newest or 0) < self._joints.newest


def _between(first: np.ndarray, second: np.ndarray, share: float, unit: bool) -> np.ndarray:
    """Values on the line between two samples; of unit quaternions on the arc, near enough."""
    if unit and first @ second < 0.0:
        second = -second
    values = first + share * (second - first)
    return values / np.linalg.norm(values) if unit else values


def _reset_follows(newest: int, stamp: int) -> bool:
    """Whether a stamp is that of a reset in lockstep: the whole second after the tick at which the clock stood."""
    return newest % PERIOD == 0 and stamp == (newest // SECOND + 1) * SECOND


def _grid_up(stamp: int) -> int:
    return -(-stamp // PERIOD) * PERIOD
