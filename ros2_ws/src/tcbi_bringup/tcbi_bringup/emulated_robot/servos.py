"""Eighteen bus servos: timed moves generated in the servo, a quantised position loop, a torque limit.

Every servo runs its own 1 kHz loop, as the firmware of a hobby bus servo does: the goal is a whole number of encoder
steps, a move is a linear ramp from the last commanded position, the ramp's value is a whole number of steps again, and
the loop turns the error (in steps) into motor torque up to the limit of its drive.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

STEP = 2 * math.pi / 4096  # rad of one encoder count (Feetech STS series, 12 bit over a turn)
LOOP_PERIOD_S = 1e-3


@dataclass(frozen=True)
class Move:
    """A goal on its way along the bus."""

    due: float  # s, when the servo takes it
    index: int
    goal: float  # rad
    duration: float  # s
    speed: float  # rad/s


class Servos:
    """The position loops of all joints.

    Args:
      gain: (J,) N m per rad of position error, the scatter between servos included.
      torque_limit: (J,) N m at the output shaft, at full duty.
      max_speed: rad/s of a move for which neither time nor speed was asked.
    """

    def __init__(self, gain: np.ndarray, torque_limit: np.ndarray, max_speed: float):
        self.gain, self.torque_limit, self._max_speed = gain, torque_limit, max_speed
        self._low_limit = -torque_limit
        count = len(gain)
        self.on = np.ones(count)
        self._start, self._span = np.zeros(count), np.zeros(count)
        self._begin, self._rate = np.zeros(count), np.full(count, 1e9)
        self._goal, self._reference, self._torque = np.zeros(count), np.zeros(count), np.zeros(count)
        self._pending: deque[Move] = deque()

    def reset(self, position: np.ndarray) -> None:
        """All servos hold `position` (J,) rad, with their torque on and no move under way."""
        self._pending.clear()
        self.on[:] = 1.0
        self._start[:] = self._goal[:] = self._reference[:] = np.rint(position / STEP) * STEP
        self._span[:] = 0.0
        self._begin[:] = 0.0
        self._rate[:] = 1e9

    def send(self, move: Move) -> None:
        """Put a goal on the bus; goals arrive in the order in which they were sent."""
        if self._pending and self._pending[-1].due > move.due:
            move = Move(self._pending[-1].due, move.index, move.goal, move.duration, move.speed)
        self._pending.append(move)

    @property
    def goal(self) -> np.ndarray:
        """(J,) rad, where the present moves end."""
        return self._goal

    def switch(self, index: int, on: bool, position: float) -> None:
        """Torque of one servo; when it comes on, the servo holds `position` (rad), where its encoder stands."""
        if on and not self.on[index]:
            self._pending = deque(m for m in self._pending if m.index != index)
            self._start[index] = self._goal[index] = self._reference[index] = round(position / STEP) * STEP
            self._span[index] = 0.0
        self.on[index] = float(on)

    def torque(self, time: float, encoder: np.ndarray) -> np.ndarray:
        """One turn of the loops.

        Args:
          time: s on the robot's clock, the middle of the turn: the torque stands until its end.
          encoder: (J,) rad, whole steps.

        Returns:
          (J,) N m at the output shafts; the array is reused by the next call.
        """
        while self._pending and self._pending[0].due <= time:
            self._take(self._pending.popleft())
        reference = self._reference
        np.subtract(time, self._begin, out=reference)
        np.multiply(reference, self._rate, out=reference)
        np.minimum(reference, 1.0, out=reference)
        np.multiply(reference, self._span, out=reference)
        np.add(reference, self._start, out=reference)
        np.divide(reference, STEP, out=reference)
        np.rint(reference, out=reference)
        np.multiply(reference, STEP, out=reference)
        torque = self._torque
        np.subtract(reference, encoder, out=torque)
        np.multiply(torque, self.gain, out=torque)
        np.minimum(torque, self.torque_limit, out=torque)
        np.maximum(torque, self._low_limit, out=torque)
        np.multiply(torque, self.on, out=torque)
        return torque

    def _take(self, move: Move) -> None:
        """Start a move when its goal has come in; a limp servo remembers nothing of it."""
        i = move.index
        if not self.on[i]:
            return
        start = self._start[i] + self._span[i] * min(max((move.due - self._begin[i]) * self._rate[i], 0.0), 1.0)
        goal = round(move.goal / STEP) * STEP
        duration = move.duration
        if duration <= 0:
            duration = abs(goal - start) / (move.speed if move.speed > 0 else self._max_speed)
        self._start[i], self._span[i], self._goal[i] = start, goal - start, goal
        self._begin[i], self._rate[i] = move.due, 1.0 / max(duration, LOOP_PERIOD_S)
