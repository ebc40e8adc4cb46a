"""The commands of a recording, as and when the servos were given them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_contract.names import JOINT_COMMANDS
from tcbi_contract.wording import counted
from tcbi_infer.bags.streams import Record, Recording, ordered
from tcbi_sim.measurement import Commands

MOST_DELAY_NS = 100_000_000

Row = tuple[int, np.ndarray, float, bool]  # stamp (ns), targets, ramp (s), torque on


def read_commands(
    recording: Recording, joint_names: tuple[str, ...], begin: int, end: int | None, notes: list[str]
) -> Commands:
    """The commands between BEGIN and END; one given at END's own stamp has no effect and is left out.

    A trajectory of several points counts as several commands. A point without positions but with effort is a torque
    (N m); one with positions and an effort of zero, or a trajectory without points, is a command with the torque off.
    """
    rows: list[Row] = []
    sent: list[int] = []  # ns, when the robot got each row
    strange = 0
    records = recording.records.get(JOINT_COMMANDS, [])
    for record, delay in zip(records, sending_delays(records), strict=True):
        found = _rows(record, joint_names, rows[-1][1] if rows else None)
        if found is None:
            strange += 1
        else:
            rows += found
            sent += [row[0] + int(delay) for row in found]
    if strange:
        notes.append(f"{JOINT_COMMANDS}: left out {counted(strange, 'message')} without the names of the rig's joints")
    if not rows:
        notes.append(f"no {JOINT_COMMANDS}: nothing can be simulated again with the same commands")
        return Commands(np.empty(0), np.empty((0, len(joint_names))))
    stamp = np.array([row[0] for row in rows], np.int64)
    order = ordered(JOINT_COMMANDS, stamp, notes)
    order = order[(stamp[order] >= begin) & ((stamp[order] < end) if end is not None else True)]
    arrival = np.array(sent, np.int64)[order]
    later = np.minimum.accumulate(np.r_[arrival[1:], np.iinfo(np.int64).max][::-1])[::-1]
    order = order[arrival < later]  # of two that came together the first has no effect
    return _commands([(sent[i], *rows[i][1:]) for i in order], len(joint_names), begin, notes)


def sending_delays(records: Sequence[Record]) -> np.ndarray:
    """(K,) ns, how long after its stamp each command came to the recorder, and so to the robot.

    A command bears the stamp of its control tick. The policy sends it when the sensors of that tick have arrived, some
    ten milliseconds later in real time, and at times much later where the machine is busy; taken for the robot's, that
    time would look like a latency. Recordings of simulated time have none, and where the recorder's clock is another
    one than the stamps' nothing is corrected.
    """
    delays = np.array([record.log_time - record.stamp for record in records], np.int64)
    known = len(delays) > 0 and 0 < np.median(delays) < MOST_DELAY_NS
    return np.maximum(delays, 0) if known else np.zeros_like(delays)


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
