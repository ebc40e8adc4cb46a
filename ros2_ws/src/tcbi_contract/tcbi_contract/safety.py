"""What may reach the servos, and when they must go limp: alike for the robot and its simulation.

Pure: time comes in as seconds of a steady clock, or of a simulated one.

    safety = Safety(Limits())
    safety.measured(now, positions)                          # every complete reading of the joints
    target = ordered_target(names, positions)                # refuses wrong names, NaN, infinity
    move = safety.command(now, target, duration_s=0.2)       # clamps, limits the speed, arms if limp
    if safety.tick(now): ...                                 # True once it has gone limp by itself

Limp means torque off. Out of it leads only a command; after an emergency stop, a lost link or a silent servo only
`begin_reset`, so that a policy that never stopped publishing cannot raise the robot into somebody's hands.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from tcbi_contract.errors import TcbiError
from tcbi_contract.names import CONTROL_PERIOD_S, JOINT_LIMIT, JOINTS

SHORTEST_MOVE_S, LONGEST_MOVE_S = 0.02, 2.0
STALE_S = 2 * CONTROL_PERIOD_S


class CommandRefused(TcbiError):
    """A command that must not reach the servos."""


@dataclass(frozen=True)
class Limits:
    """What the robot may do.

    Attributes:
      joint_limit: rad either side of the neutral stance.
      max_speed: rad/s of a commanded ramp.
      approach_speed: rad/s of the ramps from a limp robot to where the commands are.
      silence_s: torque goes off after this long without a command; also without a reading of all joints.
      hold_s: how long the posture of a reset is held while waiting for the first command.
    """

    joint_limit: float = JOINT_LIMIT
    max_speed: float = 4.5
    approach_speed: float = 0.8
    silence_s: float = 2 * CONTROL_PERIOD_S
    hold_s: float = 10.0


class Mode(Enum):
    """Limp: torque off. Active: holding or moving. Stopped: limp by emergency stop, until released."""

    LIMP = "limp"
    ACTIVE = "active"
    STOPPED = "emergency stop"


@dataclass(frozen=True)
class Move:
    """A linear ramp of all joints.

    Attributes:
      start: (18,) rad, where the ramp begins: where the last one has got to by now.
      target: (18,) rad, after all limits.
      duration_s: time of the ramp.
      arm: the torque is off and has to come on first, with `start` as the goal.
      limited: joints whose target was clamped or slowed down.
    """

    start: tuple[float, ...]
    target: tuple[float, ...]
    duration_s: float
    arm: bool
    limited: tuple[str, ...]


def ordered_target(names: Sequence[str], positions: Sequence[float]) -> tuple[float, ...]:
    """A command's positions in the contract's joint order.

    Raises:
      CommandRefused: the names are not the 18 joints, or a position is not a finite number.
    """
    if len(names) != len(positions):
        raise CommandRefused(
            f"joint_commands: got {len(names)} names and {len(positions)} positions, allowed is one each"
        )
    if sorted(names) != sorted(JOINTS):
        unknown = sorted(set(names) - set(JOINTS))
        missing = [name for name in JOINTS if name not in names]
        twice = sorted({name for name in names if list(names).count(name) > 1})
        raise CommandRefused(
            f"joint_commands: joints unknown {unknown}, missing {missing}, twice {twice}; name all 18 once"
        )
    wrong = [f"{n}={p}" for n, p in zip(names, positions, strict=True) if not math.isfinite(p)]
    if wrong:
        raise CommandRefused(f"joint_commands: got {', '.join(wrong)}, allowed are finite numbers (rad)")
    place = dict(zip(names, positions, strict=True))
    return tuple(float(place[name]) for name in JOINTS)


def check_age(stamp_s: float, now_s: float, last_stamp_s: float) -> None:
    """Refuse a command from the past, from the future, or overtaken by another; a zero stamp means now.

    Args:
      stamp_s: the command's stamp on the ROS clock.
      now_s: the ROS clock.
      last_stamp_s: the newest stamp accepted so far, 0 for none.

    Raises:
      CommandRefused: with the age.
    """
    if stamp_s == 0:
        return
    age = now_s - stamp_s
    if not -STALE_S <= age <= STALE_S:
        raise CommandRefused(
            f"joint_commands: stamp is {age:.3f} s old, allowed is -{STALE_S} to {STALE_S} s; check the clocks, or "
            "whether a recording is being played into the live topic"
        )
    if stamp_s < last_stamp_s:
        raise CommandRefused(f"joint_commands: stamp {stamp_s:.3f} s is older than the last one, {last_stamp_s:.3f} s")


class Safety:
    """State between commands and servos. All times are seconds of one steady clock.

    Attributes:
      mode: limp, active or stopped.
      reason: why the robot is limp, in words.
      needs_reset: commands are refused until `begin_reset`.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.mode = Mode.LIMP
        self.reason = "no command yet"
        self.needs_reset = False
        self.resetting = False
        self._approaching = True
        self._ramp: Move | None = None
        self._ramp_s = 0.0
        self._measured: tuple[float, ...] = ()
        self._measured_s = -math.inf
        self._deadline_s = math.inf

    @property
    def position(self) -> tuple[float, ...]:
        """(18,) rad, the last reading of all joints; empty before the first."""
        return self._measured

    def measured(self, now: float, position: Sequence[float]) -> None:
        """All joints were read just now (rad)."""
        self._measured = tuple(position)
        self._measured_s = now

    def knows_joints(self, now: float) -> bool:
        """Whether the last reading of the joints is fresh enough to move from."""
        return now - self._measured_s <= self.limits.silence_s

    def tick(self, now: float) -> bool:
        """Look at the clock; True if that has just made the robot limp."""
        if self.mode is not Mode.ACTIVE:
            return False
        if not self.knows_joints(now):
            self.go_limp(f"no reading of all joints for {self.limits.silence_s} s", needs_reset=True)
            return True
        if now > self._deadline_s:
            self.go_limp("no command in time")
            return True
        return False

    def patience(self, now: float) -> float:
        """Seconds until silence makes the robot limp; infinite if it is limp."""
        return self._deadline_s - now if self.mode is Mode.ACTIVE else math.inf

    def command(self, now: float, target: Sequence[float], duration_s: float, from_reset: bool = False) -> Move:
        """Turn a target into a ramp that the robot may do, and arm it if it is limp.

        Args:
          target: (18,) finite, rad.
          duration_s: the ramp's time.
          from_reset: the command comes from the driver's own posture move.

        Raises:
          CommandRefused: the mode forbids it, or the joints are not known.
        """
        self._check_mode(now, from_reset)
        if not SHORTEST_MOVE_S <= duration_s <= LONGEST_MOVE_S:
            raise CommandRefused(
                f"joint_commands: time_from_start is {duration_s:.3f} s, "
                f"allowed is {SHORTEST_MOVE_S} to {LONGEST_MOVE_S} s"
            )
        arm = self.mode is Mode.LIMP
        if arm:
            self._approaching = True
        start = self._measured if arm else self._setpoint(now)
        limit = self.limits.joint_limit
        inside = [min(max(t, -limit), limit) for t in target]
        slow = self._approaching or from_reset
        reach = (self.limits.approach_speed if slow else self.limits.max_speed) * duration_s
        safe = tuple(s + min(max(t - s, -reach), reach) for s, t in zip(start, inside, strict=True))
        limited = tuple(n for n, t, s in zip(JOINTS, target, safe, strict=True) if abs(t - s) > 1e-9)
        if all(abs(t - s) <= 1e-9 for t, s in zip(inside, safe, strict=True)):
            self._approaching = False
        self.mode, self.reason = Mode.ACTIVE, ""
        self._deadline_s = now + self.limits.silence_s
        self._ramp, self._ramp_s = Move(start, safe, duration_s, arm, limited), now
        return self._ramp

    def hold(self, now: float) -> None:
        """A reset is done: keep its posture for a while without commands."""
        self.resetting = False
        self._deadline_s = now + self.limits.hold_s

    def begin_reset(self, now: float) -> tuple[float, ...]:
        """Somebody asked for the initial posture: commands are allowed again afterwards.

        Returns:
          (18,) rad, where the move begins.

        Raises:
          CommandRefused: an emergency stop stands, another reset runs, or the joints are not known.
        """
        if self.mode is Mode.STOPPED:
            raise CommandRefused("reset: the emergency stop stands; call emergency_stop/release first")
        if self.resetting:
            raise CommandRefused("reset: another reset is still moving the robot")
        self._check_feedback(now, "reset")
        self.needs_reset, self.resetting = False, True
        return self._setpoint(now) if self.mode is Mode.ACTIVE else self._measured

    def go_limp(self, reason: str, needs_reset: bool = False) -> None:
        """Torque off, and why. An emergency stop that stands keeps standing."""
        self.resetting = False
        self.needs_reset = self.needs_reset or needs_reset
        if self.mode is not Mode.STOPPED:
            self.mode, self.reason = Mode.LIMP, reason

    def stop(self, reason: str = "emergency stop") -> None:
        """Emergency stop: limp until released."""
        self.go_limp(reason, needs_reset=True)
        self.mode, self.reason = Mode.STOPPED, reason

    def release(self) -> bool:
        """End the emergency stop; the robot stays limp. False if none stood."""
        if self.mode is not Mode.STOPPED:
            return False
        self.mode, self.reason = Mode.LIMP, "emergency stop released"
        return True

    def _setpoint(self, now: float) -> tuple[float, ...]:
        """(18,) rad, how far the last ramp has got. So a command that comes early is no way round the speed limit."""
        ramp = self._ramp
        assert ramp is not None
        share = min(max((now - self._ramp_s) / ramp.duration_s, 0.0), 1.0)
        return tuple(s + share * (t - s) for s, t in zip(ramp.start, ramp.target, strict=True))

    def _check_mode(self, now: float, from_reset: bool) -> None:
        if self.mode is Mode.STOPPED:
            raise CommandRefused(
                "joint_commands: the emergency stop stands; call emergency_stop/release, then reset_episode"
            )
        if self.resetting and not from_reset:
            raise CommandRefused("joint_commands: the robot is moving to its initial posture")
        if from_reset and not self.resetting:
            raise CommandRefused(f"reset: interrupted: {self.reason}")
        if self.needs_reset:
            raise CommandRefused(f"joint_commands: limp ({self.reason}); call reset_episode to arm the robot again")
        self._check_feedback(now, "joint_commands")

    def _check_feedback(self, now: float, what: str) -> None:
        if not self.knows_joints(now):
            raise CommandRefused(f"{what}: where the joints are is not known; see diagnostics")
