"""One connection to the robot: the 50 Hz cycle of reading, and everything that moves a servo.

All methods run in the one thread that owns the port. `receive` waits a few milliseconds for bytes and hands what came
to the sink; `act` does what is due. In this order, so that a thread that was held up looks at its mail before it judges
the robot silent. Any failure of the wire leaves as `LinkLost`; the safety state outlives the connection.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from hexapod_driver import feetech, sensor_board
from hexapod_driver.calibration import Calibration
from hexapod_driver.errors import LinkLost
from hexapod_driver.feetech import Packet, TimedMove
from hexapod_driver.posture import PostureGoal, PostureMove
from hexapod_driver.readings import BoardReading, Health, JointReading, Reading
from hexapod_driver.sensor_board import FrameError, Kind
from hexapod_driver.startup import BOOT_S
from hexapod_driver.timer import Timer
from hexapod_driver.wire import KEEP_ALIVE_S, BoardFrame, BusReply, Wire
from tcbi_contract.names import CONTROL_PERIOD_S, JOINTS, SENSOR_RATE_HZ
from tcbi_contract.safety import CommandRefused, Mode, Move, Safety

POLL_S = 0.01
READ_PERIOD_S = 1 / SENSOR_RATE_HZ
# joints are measured so long after the multiples of the period, hence after each control tick, which the policy notices
# by the next sample: close behind it, yet far enough that no jitter brings a sample to the tick's other side
READ_PHASE_S, PHASE_GAIN = 0.005, 0.1
HEALTH_PERIOD_S = 1.0
TORQUE_CHECK_S = 0.5
STREAM_RETRY_S = 0.2
CONFIRM_S = 0.5  # time that the servos of a limp robot have to say that their torque is off
KNOWN_S = 1.0  # time that a reset has to learn where the joints are
LAST_WORDS, LAST_WORD_S = 3, 0.01
HEALTH_BYTES = 8  # position, speed, load, voltage, temperature from address 56


Done = Callable[[bool, str], None]


class AskedPosture(NamedTuple):
    """A posture that cannot begin yet: since a stall of this computer, where the joints are is not known."""

    goal: PostureGoal
    done: Done
    patience_s: float  # until when, on the steady clock


class Robot:
    """A connected robot.

    Args:
      wire: open and checked.
      safety: outlives the connection.
      sink: takes every reading.
      watchdog_ms: silence after which the board makes the servos limp without being told.
    """

    def __init__(
        self, wire: Wire, calibration: Calibration, safety: Safety, sink: Callable[[Reading], None], watchdog_ms: int
    ) -> None:
        self.wire = wire
        self.health = Health()
        self._calibration = calibration
        self._safety = safety
        self._sink = sink
        self._watchdog_ms = watchdog_ms
        self._names = dict(zip(calibration.servos, JOINTS, strict=True))
        now = time.monotonic()
        self._read_timer = Timer(READ_PERIOD_S, now)
        self._health_timer = Timer(HEALTH_PERIOD_S, now)
        self._torque_timer = Timer(TORQUE_CHECK_S, now + TORQUE_CHECK_S)
        self._limp_timer = Timer(CONTROL_PERIOD_S, now)
        self._alive_timer = Timer(KEEP_ALIVE_S, now)
        self._stream_timer = Timer(STREAM_RETRY_S, now)
        self._last_sample = now
        self._last_board_us: int | None = None
        self._purpose: dict[int, Callable[[BusReply], None]] = {}
        self._asked: AskedPosture | None = None
        self._posture: PostureMove | None = None
        self._stops: list[tuple[float, Done]] = []
        self._armed = True  # for all that is known: torque off was not said since the servos may have had torque
        self._limp_count = 0  # so far
        self._confirm_by = math.inf  # until when, on the steady clock; infinite while active and once confirmed
        self._awake_by = now  # until when the servos may be starting, since the board has given their power back

    def receive(self) -> None:
        """Wait for bytes, at most 10 ms, and hand on what they say."""
        left = self._read_timer.left(time.monotonic())
        for event in self.wire.poll(min(POLL_S, left)):
            if isinstance(event, BoardFrame):
                self._take_board(event)
            elif (purpose := self._purpose.pop(event.tag, None)) is not None:
                purpose(event)

    def act(self) -> None:
        """Do what is due: go on with a posture, look at the watchdogs, ask the robot."""
        now = time.monotonic()
        self._wait_for_joints(now)
        self._continue_posture(now)
        self._watch(now)
        self._request(now)

    def command(self, target: Sequence[float], duration_s: float) -> None:
        """Move towards `target` (18,) rad.

        Raises:
          CommandRefused: see `Safety.command`.
        """
        self._send_move(self._safety.command(time.monotonic(), target, duration_s))

    def begin_posture(self, goal: PostureGoal, done: Done) -> None:
        """Move slowly to a posture; `done` is called once with success and a line.

        It begins when a reading has told where the joints are, at once where the last one is fresh.

        Raises:
          CommandRefused: see `Safety.begin_reset`.
        """
        now = time.monotonic()
        asked = AskedPosture(goal, done, now + KNOWN_S)
        if self._asked is None and not self._safety.knows_joints(now):
            self._asked = asked
        else:
            self._begin_posture(now, asked)

    def stop(self, done: Done) -> None:
        """Emergency stop; `done` is called when all servos confirm that their torque is off, or after half a second."""
        now = time.monotonic()
        self._forget_asked("interrupted: emergency stop")
        self._safety.stop()
        self._stops.append((now + CONFIRM_S, done))
        self._await_confirmation(now)
        self._limp(now)

    def torque_off(self) -> tuple[int, ...]:
        """Take the torque off for good, before the port is closed. Returns the ids that do not confirm it."""
        servos = self._calibration.servos
        for _ in range(3):
            self.wire.submit(feetech.torque(servos, False))
            packets = self.wire.transact(self._torque_question(), servos, 0.15)
            off = {p.id for p in packets if p.params == b"\x00"}
            if off.issuperset(servos):
                return ()
        return tuple(s for s in servos if s not in off)

    def last_torque_off(self) -> None:
        """Say it once more to a robot whose link counts as lost; a servo that is just answering may miss it once.

        Raises:
          LinkLost: the servos' port is what was lost.
        """
        for _ in range(LAST_WORDS):
            self.wire.shout(feetech.torque(self._calibration.servos, False))
            time.sleep(LAST_WORD_S)

    def abandon(self, reason: str) -> None:
        """The connection is over: tell everybody who waits."""
        self._forget_asked(reason)
        if self._posture is not None:
            self._finish_posture(False, reason)
        stops, self._stops = self._stops, []
        for _, done in stops:
            done(False, f"emergency stop stands, but the servos did not confirm: {reason}; cut the power to be sure")

    # What is due

    def _watch(self, now: float) -> None:
        silence = self._safety.limits.silence_s
        if now - self._last_sample > silence:
            raise LinkLost(f"no sample from the sensor board for {silence} s ({self.wire.bad_frames} damaged frames)")
        self._safety.tick(now)
        if self._safety.mode is not Mode.ACTIVE and (self._armed or self._limp_timer.due(now)):
            self._limp(now)
        self._look_for_torque(now)

    def _request(self, now: float) -> None:
        servos = self._calibration.servos
        if self._health_timer.due(now):
            self._ask(feetech.sync_read(servos, feetech.PRESENT_POSITION, HEALTH_BYTES), self._take_health)
        if self._torque_timer.due(now):
            self._ask_torque()
        if self._read_timer.due(now):
            self._ask(feetech.sync_read(servos, feetech.PRESENT_POSITION, 2), self._take_positions)
        if self.health.unconfirmed:
            return  # the board's watchdog is left to act
        if self._alive_timer.due(now):
            self.wire.send_board(Kind.KEEP_ALIVE)
        quiet = not self.health.board_samples or now - self._last_sample > STREAM_RETRY_S
        if self._stream_timer.due(now) and quiet:
            self._start_stream()

    def _ask(self, packet: bytes, purpose: Callable[[BusReply], None]) -> None:
        if len(self._purpose) >= self.wire.most_in_flight:
            self.health.skipped_questions += 1
            return
        tag = self.wire.submit(packet, self._calibration.servos)
        self._purpose[tag] = purpose

    def _start_stream(self) -> None:
        payload = sensor_board.stream_payload(sensor_board.STREAM_RATE_HZ, self._watchdog_ms)
        self.wire.send_board(Kind.STREAM, payload)

    def _torque_question(self) -> bytes:
        return feetech.sync_read(self._calibration.servos, feetech.TORQUE_ENABLE, 1)

    def _ask_torque(self) -> None:
        expect_on, limp_count = self._safety.mode is Mode.ACTIVE, self._limp_count
        self._ask(self._torque_question(), lambda reply: self._take_torque(reply, expect_on, limp_count))

    def _limp(self, now: float) -> None:
        """Torque off, said again and again while limp, since a sync write is not acknowledged, and read back."""
        if self._armed:
            self._await_confirmation(now)
        self.wire.submit(feetech.torque(self._calibration.servos, False))
        if self._confirm_by < math.inf:
            self._ask_torque()
        self._limp_timer.soon(now, CONTROL_PERIOD_S)

    def _await_confirmation(self, now: float) -> None:
        """Every servo has to say anew that its torque is off; a deadline that stands is not put off."""
        self._armed = False
        self._limp_count += 1
        self.health.torque = {}
        self._confirm_by = min(self._confirm_by, now + CONFIRM_S)

    def _look_for_torque(self, now: float) -> None:
        """Whether all servos of a limp robot have confirmed that; those that have not are the board's from then on."""
        unsure = tuple(s for s in self._calibration.servos if self.health.torque.get(s, True))
        if not unsure:
            self._confirm_by = math.inf
        self.health.unconfirmed = unsure if now > max(self._confirm_by, self._awake_by) else ()
        self._answer_stops(now, unsure)

    def _answer_stops(self, now: float, unsure: Sequence[int]) -> None:
        waiting = []
        for deadline, done in self._stops:
            if not unsure:
                done(True, f"all {len(self._calibration.servos)} servos confirm that their torque is off")
            elif now > deadline:
                text = f"servos {list(unsure)} did not confirm; cut the power to be sure"
                done(False, f"emergency stop stands, but {text}")
            else:
                waiting.append((deadline, done))
        self._stops = waiting

    # What arrives

    def _take_board(self, event: BoardFrame) -> None:
        if event.frame.kind != Kind.SAMPLE:
            return
        try:
            sample = sensor_board.parse_sample(event.frame.payload)
        except FrameError:
            self.wire.counters.bad_payloads += 1
            return
        if sample.time_us == self._last_board_us:
            return  # said twice
        self._last_board_us = sample.time_us
        now = self._last_sample = time.monotonic()
        self.wire.board_clock.observe(sample.time_us, event.arrival_ns)
        if sample.watchdog_tripped:
            if self._safety.mode is Mode.ACTIVE:
                self._safety.go_limp("the sensor board's watchdog took the torque off", needs_reset=True)
            if not self.health.unconfirmed:
                self._start_stream()  # which clears the board's flag, and gives the servos their power back
                self._awake_by = now + BOOT_S + CONFIRM_S
        self.health.board_samples += 1
        self._sink(BoardReading(self.wire.board_clock.stamp(sample.time_us, event.arrival_ns), sample))

    def _take_positions(self, reply: BusReply) -> None:
        steps = {p.id: int.from_bytes(p.params, "little") for p in self._answers(reply, 2)}
        sound = {servo: step for servo, step in steps.items() if step < feetech.STEPS_PER_TURN}
        silent = tuple(s for s in self._calibration.servos if s not in sound)
        self.health.silent_servos = silent
        if silent:
            self.health.incomplete_reads += 1
            return
        position = tuple(self._calibration.to_radian(name, sound[servo]) for servo, name in self._names.items())
        self._read_timer.shift(-PHASE_GAIN * _out_of_phase(reply.stamp_ns))
        self._safety.measured(time.monotonic() - self.wire.age_s(reply.stamp_ns), position)
        self.health.joint_readings += 1
        self._sink(JointReading(reply.stamp_ns, position))

    def _take_health(self, reply: BusReply) -> None:
        packets = self._answers(reply, HEALTH_BYTES)
        voltage, temperature = (
            r - feetech.PRESENT_POSITION for r in (feetech.PRESENT_VOLTAGE, feetech.PRESENT_TEMPERATURE)
        )
        self.health.voltage = {p.id: p.params[voltage] / 10 for p in packets}
        self.health.temperature = {p.id: p.params[temperature] for p in packets}

    def _take_torque(self, reply: BusReply, expect_on: bool, limp_count: int) -> None:
        told = {p.id: p.params != b"\x00" for p in self._answers(reply, 1)}
        if limp_count != self._limp_count:
            return  # asked before the robot was last told to be limp, which it cannot confirm
        self.health.torque |= told
        lost = [f"{self._names[s]} (id {s})" for s, on in told.items() if not on]
        if expect_on and lost and self._safety.mode is Mode.ACTIVE:
            self._safety.go_limp(
                f"no torque at {', '.join(lost)}: overload protection or a restarted servo", needs_reset=True
            )
            self._limp(time.monotonic())

    def _answers(self, reply: BusReply, length: int) -> list[Packet]:
        packets = [p for p in reply.packets if p.id in self._names and len(p.params) == length]
        for packet in packets:
            self.health.errors[packet.id] = packet.code
        return packets

    # What moves

    def _begin_posture(self, now: float, asked: AskedPosture) -> None:
        self._end_interrupted_posture()
        start, speed = self._safety.begin_reset(now), self._safety.limits.approach_speed
        self._posture = PostureMove(asked.goal, start, speed, now, asked.done)

    def _forget_asked(self, reason: str) -> None:
        asked, self._asked = self._asked, None
        if asked is not None:
            asked.done(False, reason)

    def _wait_for_joints(self, now: float) -> None:
        asked = self._asked
        if asked is None or (now < asked.patience_s and not self._safety.knows_joints(now)):
            return
        self._asked = None
        try:
            self._begin_posture(now, asked)
        except CommandRefused as error:
            asked.done(False, str(error))

    def _end_interrupted_posture(self) -> None:
        if self._posture is not None and not self._safety.resetting:
            self._finish_posture(False, f"interrupted: {self._safety.reason}")

    def _continue_posture(self, now: float) -> None:
        self._end_interrupted_posture()
        posture = self._posture
        if posture is None:
            return
        if posture.due(now):
            try:
                self._send_move(self._safety.command(now, posture.goal.target, CONTROL_PERIOD_S, from_reset=True))
            except CommandRefused as error:
                self._finish_posture(False, str(error))
                return
        outcome = posture.outcome(now, self._safety.position)
        if outcome is not None:
            self._finish_posture(*outcome)

    def _finish_posture(self, success: bool, text: str) -> None:
        assert self._posture is not None
        done, self._posture = self._posture.done, None
        now = time.monotonic()
        if success:
            self._safety.hold(now)
        elif self._safety.resetting:
            self._safety.go_limp(f"reset: {text}", needs_reset=True)
            self._limp(now)
        done(success, text)

    def _send_move(self, move: Move) -> None:
        if move.limited:
            self.health.limited_commands += 1
        if move.arm:
            self._arm(move.start)
        steps = self._steps(move.start), self._steps(move.target)
        time_ms = round(move.duration_s * 1000)
        moves = {
            servo: TimedMove(steps[1][servo], time_ms, _speed(steps[1][servo] - steps[0][servo], move.duration_s))
            for servo in self._calibration.servos
        }
        self.wire.submit(feetech.timed_moves(moves))

    def _arm(self, start: Sequence[float]) -> None:
        """Goals to where the joints are, then torque on: a servo that wakes up must not jump to an old goal."""
        here = {servo: TimedMove(step, 0, 1) for servo, step in self._steps(start).items()}
        self.wire.submit(feetech.timed_moves(here))
        self.wire.submit(feetech.torque(self._calibration.servos, True))
        self._armed, self._confirm_by = True, math.inf
        self._torque_timer.soon(time.monotonic(), 0.1)

    def _steps(self, position: Sequence[float]) -> dict[int, int]:
        names = zip(self._calibration.servos, JOINTS, position, strict=True)
        return {servo: self._calibration.to_step(name, angle) for servo, name, angle in names}


def _speed(steps: int, duration_s: float) -> int:
    """Steps/s that make a ramp last `duration_s`; never 0, which a servo takes for as fast as it can."""
    return min(max(round(abs(steps) / duration_s), 1), 32767)


def _out_of_phase(stamp_ns: int) -> float:
    """By how much (s) a joint reading is late, of half a period at most; negative if it is early."""
    half = READ_PERIOD_S / 2
    return (stamp_ns * 1e-9 - READ_PHASE_S + half) % READ_PERIOD_S - half
