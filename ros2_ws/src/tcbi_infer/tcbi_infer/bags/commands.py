"""The commands of a recording, as the servos were given them."""

from typing import Any

import numpy as np

from tcbi_contract.names import JOINT_COMMANDS
from tcbi_contract.wording import counted
from tcbi_infer.bags.streams import Record, Recording, ordered
from tcbi_sim.measurement import Commands

MOST_DELAY_NS = 100_000_000
LATE_NS = 100_000_000  # more than usual: the robot has been told something else for half a control period

Row = tuple[int, np.ndarray, float, bool]  # stamp (ns), targets, ramp (s), torque on


def read_commands(
    recording: Recording, joint_names: tuple[str, ...], begin: int, end: int | None, notes: list[str]
) -> Commands:
    """The commands between BEGIN and END; one given at END's own stamp has no effect and is left out.

    A trajectory of several points counts as several commands. A point without positions but with effort is a torque
    (N m); one with positions and an effort of zero, or a trajectory without points, is a command with the torque off.
    """
    rows: list[Row] = []
    strange = 0
    for record in recording.records.get(JOINT_COMMANDS, []):
        found = _rows(record, joint_names, rows[-1][1] if rows else None)
        if found is None:
            strange += 1
        else:
            rows += found
    if strange:
        notes.append(f"{JOINT_COMMANDS}: left out {counted(strange, 'message')} without the names of the rig's joints")
    if not rows:
        notes.append(f"no {JOINT_COMMANDS}: nothing can be simulated again with the same commands")
        return Commands(np.empty(0), np.empty((0, len(joint_names))))
    stamp = np.array([row[0] for row in rows], np.int64)
    delay = sending_delay(recording.records[JOINT_COMMANDS])
    order = ordered(JOINT_COMMANDS, stamp, notes)
    inside = (stamp[order] >= begin) & ((stamp[order] < end) if end is not None else True)
    return _commands([rows[i] for i in order[inside]], len(joint_names), begin - delay, notes)


def sending_delay(records: list[Record]) -> int:
    """How long after their stamps commands were sent (ns): the median delay of their arrival at the recorder.

    A command bears the stamp of its control tick. The policy sends it when the sensors of that tick have arrived, some
    ten milliseconds later in real time; taken for the robot's, that time would look like a latency. Recordings of
    simulated time have none, and where the recorder's clock is another one than the stamps' nothing is corrected.
    """
    delays = np.array([record.log_time - record.stamp for record in records])
    median = int(np.median(delays))
    return median if 0 < median < MOST_DELAY_NS else 0


def late_commands(recording: Recording, begin: int, end: int | None) -> list[tuple[float, float]]:
    """From when commands were due to when they came (s), of those that came much later than usual: a stalled machine.

    Where the clocks of stamps and recorder differ, or time is simulated, nothing is known of it.
    """
    records = recording.records.get(JOINT_COMMANDS, [])
    usual = sending_delay(records) if records else 0
    if not usual:
        return []
    late = [r for r in records if r.log_time - r.stamp - usual > LATE_NS and begin <= r.stamp < (end or r.stamp + 1)]
    return [((r.stamp - begin) / 1e9, (r.log_time - begin) / 1e9) for r in late]


def _rows(record: Record, joint_names: tuple[str, ...], last: np.ndarray | None) -> list[Row] | None:
    message: Any = record.message
    named = tuple(message.joint_names)
    if not message.points:
        return None if last is None else [(record.stamp, last, 0.0, False)]
    if not set(joint_names) <= set(named):
        return None
    pick = [named.index(name) for name in joint_names]
    rows: list[Row] = []
    before = 0  # ns
    for point in message.points:
        reached = point.time_from_start.sec * 1_000_000_000 + point.time_from_start.nanosec
        values = point.positions if len(point.positions) else point.effort
        if len(values) != len(named):
            return None
        is_off = len(point.positions) > 0 and len(point.effort) == len(named) and not np.any(point.effort)
        rows.append((record.stamp + before, values[pick], max(reached - before, 0) / 1e9, not is_off))
        before = reached
    return rows


def _commands(rows: list[Row], joints: int, begin: int, notes: list[str]) -> Commands:
    if not rows:
        notes.append(f"{JOINT_COMMANDS}: none between BEGIN and END")
        return Commands(np.empty(0), np.empty((0, joints)))
    ramps = np.array([row[2] for row in rows])
    ramp = float(np.median(ramps))
    if np.ptp(ramps) > 1e-3:
        notes.append(
            f"{JOINT_COMMANDS}: ramps from {ramps.min():.3g} to {ramps.max():.3g} s; all are taken as {ramp:.3g} s, "
            "which blurs the moments after the others"
        )
    on = np.array([row[3] for row in rows])
    return Commands(
        time=(np.array([row[0] for row in rows], np.int64) - begin) / 1e9,
        target=np.array([row[1] for row in rows]),
        ramp=ramp,
        torque_on=None if on.all() else on,
    )
