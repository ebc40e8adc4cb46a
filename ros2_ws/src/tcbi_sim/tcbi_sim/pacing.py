"""Real time for a simulation that makes one sample every period: how many are due, and with which stamps.

Stamps lie on the multiples of the period, since each sample is of a known simulated time; only their delivery jitters.
So the control ticks are among them, in every rollout alike. If the machine was held up for long, or somebody moved the
clock, they jump forward once: the simulation does not race after it.

    pacer = Pacer(period_ns=20_000_000)
    pacer.restart(steady_ns, ros_ns)
    for _ in range(pacer.due(steady_ns, ros_ns)):
        simulate(); publish(stamp=pacer.next_stamp())
"""

MAX_LAG_NS = 250_000_000  # beyond it the simulation does not catch up
MAX_DRIFT_NS = 100_000_000  # between the grid and the ROS clock


class Pacer:
    """The grid of a real-time simulation. All times in ns; `steady` never jumps, `ros` may.

    Attributes:
      slips: how often the grid jumped since it was made.
    """

    def __init__(self, period_ns: int):
        self.slips = 0
        self._period = period_ns
        self._steady0 = 0  # steady time of the grid's zero
        self._offset = 0  # ROS time minus steady time on this grid
        self._count = 0  # samples made on this grid
        self._last = -period_ns  # last stamp given

    def restart(self, steady: int, ros: int) -> int:
        """A new grid from now on, as at a reset: the stamp of its zero.

        Later than every stamp given before, unless the ROS clock was set back by more than MAX_LAG_NS since: commands
        with the clock's own stamps would be refused for good on a grid that stays ahead of it.
        """
        set_back = ros < self._last - MAX_LAG_NS
        return self._begin(steady, ros if set_back else max(ros, self._last + self._period))

    def due(self, steady: int, ros: int) -> int:
        """How many samples should exist by now and do not.

        Jumps forward if more than MAX_LAG_NS behind, or if the ROS clock ran ahead of the grid. A clock that was set
        back is followed at the next `restart`, since stamps never go back in between.
        """
        behind = steady - self._steady0 - self._count * self._period
        if behind > MAX_LAG_NS or ros - steady - self._offset > MAX_DRIFT_NS:
            self.slips += 1
            self._begin(steady, max(ros, self._last + self._period))
            return 0
        return max(0, behind // self._period)

    def next_stamp(self) -> int:
        """The stamp of the next sample."""
        self._count += 1
        self._last = self._steady0 + self._count * self._period + self._offset
        return self._last

    def since_last(self, steady: int) -> float:
        """Seconds from the last sample to now, at most one period: where before the coming sample a command falls."""
        behind = steady - self._steady0 - self._count * self._period
        return 1e-9 * min(max(behind, 0), self._period)

    def _begin(self, steady: int, stamp: int) -> int:
        ahead = -stamp % self._period
        self._steady0, self._count = steady + ahead, 0
        self._offset, self._last = stamp - steady, stamp + ahead
        return self._last
