"""From the board's microseconds to the node's ROS clock, so that a stamp says when a thing was measured."""

from collections import deque

_WINDOW_NS = 3_000_000_000
_RESTART_NS = 250_000_000
_LEAST_STEP_NS = 1_000


class BoardClock:
    """Maps the board's clock onto the clock of this computer.

    A frame arrives late by the link's delay, never early. So the smallest difference between arrival and the board's
    time over the last three seconds is the offset between the clocks, up to the least delay of the link; it follows the
    drift between them. A stamp is never later than its arrival.

    A board that was restarted counts from zero again, and a computer's clock may be set: a difference that jumps by
    more than a quarter of a second down, or a board time that goes back, starts the mapping over. (Up it jumps for
    a while whenever the link stalls; that is delay, and the window outlives it.)
    """

    def __init__(self) -> None:
        self.restarts = 0
        self._offsets: deque[tuple[int, int]] = deque()  # (board time, offset), offsets rising: the first is the least
        self._last_board: int | None = None

    def observe(self, board_us: int, arrival_ns: int) -> None:
        """Learn from one frame that carries the board's present time."""
        board_ns = board_us * 1000
        offset = arrival_ns - board_ns
        if self._last_board is not None and self._jumped(board_ns, offset):
            self.restarts += 1
            self._offsets.clear()
        self._last_board = board_ns
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((board_ns, offset))
        while self._offsets[0][0] < board_ns - _WINDOW_NS:
            self._offsets.popleft()

    def stamp(self, board_us: int, arrival_ns: int) -> int:
        """ROS time in ns of a moment on the board's clock, as well as is known by now."""
        if not self._offsets:
            return arrival_ns
        return min(board_us * 1000 + self._offsets[0][1], arrival_ns)

    def _jumped(self, board_ns: int, offset: int) -> bool:
        assert self._last_board is not None
        if board_ns < self._last_board - _RESTART_NS:
            return True
        return bool(self._offsets) and offset < self._offsets[0][1] - _RESTART_NS


class RisingStamps:
    """Keeps the stamps of one topic from repeating or going back, by the least that does it.

    Attributes:
      behind_ns: by how much the newest stamp was raised; large after a clock was set back, until it catches up.
    """

    def __init__(self) -> None:
        self.behind_ns = 0
        self._last: int | None = None

    def next(self, stamp_ns: int) -> int:
        """`stamp_ns`, or the next possible stamp after the last one."""
        self.behind_ns = 0
        if self._last is not None and stamp_ns <= self._last:
            self.behind_ns = self._last + _LEAST_STEP_NS - stamp_ns
        self._last = stamp_ns + self.behind_ns
        return self._last

    def restart(self) -> None:
        """A new rollout begins: stamps may go back to the present once."""
        self._last, self.behind_ns = None, 0
