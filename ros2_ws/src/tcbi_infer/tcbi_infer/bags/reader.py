"""Read bags as measurements.

    for measurement in read_measurements(["rollouts/", "lab/walk_3.mcap"]):
        print(measurement.rollout_id, *measurement.notes, sep="\\n  ")

Any bag of the contract will do, also one that was cut off (it is read as far as it goes), a bare file, one with a
namespace, another rate, another order of joints, or without tracker, contacts or IMU. What is missing or was repaired
is said in `Measurement.notes`, a line each. The joint states' stamps are the time axis; a signal of another topic is
taken at the same stamp unchanged, else between its neighbours: linear, contacts the last one seen.
"""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from math import degrees, pi, remainder
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.names import FOOT_CONTACTS, IMU, JOINT_STATES, JOINTS, LEGS, ROLLOUT_EVENT, TRACKER_POSE
from tcbi_contract.wording import counted
from tcbi_infer.bags.commands import read_commands
from tcbi_infer.bags.files import find_bags
from tcbi_infer.bags.readings import read_readings
from tcbi_infer.bags.rollouts import Span, lacking, rollouts
from tcbi_infer.bags.streams import Recording, Stream, load, stream
from tcbi_infer.bags.tracker import TURNED, heading, turned, wanted_heading
from tcbi_infer.errors import BagError, EmptyRolloutError
from tcbi_infer.gaps import GAP_PERIODS, GAP_S, Gap
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Measurement, Scenario, continuous
from tcbi_sim.rigs import load_rig, rig_names

HEXAPOD = "hexapod"
LEAST_COVER = 0.5  # of the rollout; a signal that covers less is left out


def read_measurement(bag: Path | str, rig: str | None = None, namespace: str | None = None) -> Measurement:
    """The one rollout of a bag.

    Raises:
      BagError: it cannot be read, is of another rig than `rig`, or holds several rollouts.
    """
    found = read_bag(Path(bag), rig, namespace)
    if len(found) > 1:
        ids = ", ".join(m.rollout_id for m in found)
        raise BagError(
            f"{bag}: holds {len(found)} rollouts ({ids}) where one is wanted; read them with read_measurements"
        )
    return found[0]


def read_measurements(
    paths: Iterable[Path | str],
    rig: str | None = None,
    namespace: str | None = None,
    left_out: Callable[[str], None] | None = None,
) -> list[Measurement]:
    """All rollouts of bags and of folders of bags, in the order given.

    Args:
      rig: the rig that the caller can use; None for any.
      left_out: told of each bag whose rollout ended before anything was measured, which is left out beside others; None
        refuses it.

    Raises:
      BagError: one of them cannot be read; two rollouts bear one id; nothing was measured in any.
    """
    found: list[Measurement] = []
    seen: dict[str, Path] = {}
    empty: list[EmptyRolloutError] = []
    for bag in find_bags(Path(p) for p in paths):
        try:
            measurements = read_bag(bag, rig, namespace)
        except EmptyRolloutError as e:
            if left_out is None:
                raise
            empty.append(e)
            continue
        for measurement in measurements:
            if measurement.rollout_id in seen:
                raise BagError(
                    f"{bag}: its rollout {measurement.rollout_id!r} is also in {seen[measurement.rollout_id]}; "
                    "give each rollout once, since it would count twice"
                )
            seen[measurement.rollout_id] = bag
            found.append(measurement)
    if empty and not found:
        raise empty[0]
    for nothing in empty:
        assert left_out is not None
        left_out(str(nothing))
    return found


def read_bag(bag: Path, rig: str | None = None, namespace: str | None = None) -> list[Measurement]:
    """All rollouts of one bag."""
    recording = load(bag, namespace)
    return [_measurement(part, span, rig) for part, span in rollouts(recording)]


def _measurement(recording: Recording, span: Span, wanted_rig: str | None) -> Measurement:
    notes = [*recording.notes, *span.notes]
    rig, joint_names, noted_names = _rig(recording, span, wanted_rig)
    joints = _within(_joints(recording, joint_names, notes), span)
    if joints is None or len(joints) < 2:
        why = "".join(f"; {note}" for note in notes if note.startswith(JOINT_STATES))
        raise EmptyRolloutError(
            f"{recording.path}: rollout {span.rollout_id!r} holds no joint_states of use after its BEGIN event{why}"
        )
    _say_gaps(JOINT_STATES, _missing(joints, joints, span), notes)
    _say_late(joints, span, notes)
    gaps: list[tuple[str, float, float]] = []
    read = partial(_signal, recording, joints=joints, span=span, notes=notes, gaps=gaps)
    imu = {name: read(IMU, row, name) for name, row in IMU_ROWS.items()}
    foot_names, contact_row = _feet(recording, rig)
    contact = read(FOOT_CONTACTS, contact_row, "contact")
    scenario = _begun(span.scenario(int(joints.stamp[-1])), noted_names, joint_names)
    position = _along_heading(read(TRACKER_POSE, _position, "position"), recording, span, scenario, notes)
    _say_missing(recording, rig, notes)
    attitude = imu["attitude"]
    return Measurement(
        rollout_id=span.rollout_id,
        rig=rig,
        scenario=scenario,
        policy_id=span.policy_id,
        source=span.source,
        commands=read_commands(recording, joint_names, span.begin, span.end, notes),
        joint_names=joint_names,
        foot_names=foot_names if contact is not None else (LEGS if rig == HEXAPOD else ()),
        time=(joints.stamp - span.begin) / 1e9,
        joint_position=joints.values,
        attitude=attitude,
        angular_velocity=imu["angular_velocity"],
        linear_acceleration=imu["linear_acceleration"],
        contact=None if contact is None else contact > 0.5,
        position=position,
        distance=span.distance,
        notes=tuple(dict.fromkeys(notes)),
        gaps=tuple(gaps),
        readings=read_readings(recording, joint_names, span.begin, int(joints.stamp[-1])),
    )


def _rig(recording: Recording, span: Span, wanted: str | None) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """The rig's name, its joints in its own order, and in the order of the note's starting posture.

    A hexapod's posture is noted in the rig's order, another robot's in that of its joint states.
    """
    records = recording.records.get(JOINT_STATES)
    if not records:
        kind = EmptyRolloutError if recording.records.get(ROLLOUT_EVENT) else BagError
        raise kind(f"{recording.path}: {lacking(recording)}")
    every = dict.fromkeys(tuple(record.message.name) for record in records)
    seen = next((names for names in every if set(JOINTS) <= set(names)), next(iter(every)))
    is_hexapod = set(JOINTS) <= set(seen)
    rig = span.note.rig or (HEXAPOD if is_hexapod else None)
    if rig == HEXAPOD and not is_hexapod:  # its note says so, its joints do not
        rig = None
    if rig is None and wanted is not None and wanted != HEXAPOD:
        rig = wanted
    if rig is None:
        missing = [name for name in JOINTS if name not in seen]
        shown = ", ".join(missing[:3]) + (" …" if len(missing) > 3 else "")
        raise BagError(
            f"{recording.path}: it is a recording of another robot: its joints are "
            f"{', '.join(seen) or 'without names'}, the hexapod's {shown} are missing; describe that robot as a rig "
            "(docs/rigs.md) and bring its logs with ./tcbi import and a mapping that names the rig (docs/bags.md)"
        )
    if wanted is not None and rig != wanted:
        raise BagError(
            f"{recording.path}: it is a recording of the rig {rig!r}, wanted is {wanted!r}; choose a model of that rig"
        )
    if rig == HEXAPOD:
        return rig, JOINTS, JOINTS
    own = _joints_of(rig, recording)
    whole = next((names for names in every if own and set(own) <= set(names)), None)
    return (rig, seen, seen) if whole is None else (rig, own, whole)


def _joints_of(rig: str, recording: Recording) -> tuple[str, ...]:
    """The joints of a rig in its own order; none where the rig is not known."""
    if rig not in rig_names():
        return ()
    try:
        return load_rig(rig).joint_names
    except SimError as e:
        raise BagError(f"{recording.path}: its rig cannot be used: {e}") from e


def _begun(scenario: Scenario, noted: tuple[str, ...], joint_names: tuple[str, ...]) -> Scenario:
    """A scenario whose starting posture and speed, noted in one order of joints, are put in the rig's."""

    def pick(values: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if values is None or len(values) != len(noted):
            return values
        return tuple(values[noted.index(name)] for name in joint_names)

    position, velocity = pick(scenario.initial_joint_position), pick(scenario.initial_joint_velocity)
    return dataclasses.replace(scenario, initial_joint_position=position, initial_joint_velocity=velocity)


def _joints(recording: Recording, joint_names: tuple[str, ...], notes: list[str]) -> Stream | None:
    picks: dict[tuple[str, ...], list[int] | None] = {}
    short = 0

    def row(message: Any) -> np.ndarray | None:
        nonlocal short
        names = tuple(message.name)
        if names not in picks:
            picks[names] = [names.index(n) for n in joint_names] if set(joint_names) <= set(names) else None
        pick = picks[names]
        if pick is None or len(message.position) != len(names):
            short += 1
            return None
        return message.position[pick]

    found = stream(JOINT_STATES, recording.records[JOINT_STATES], row, notes)
    for names, pick in picks.items():
        if pick is not None and names != joint_names:
            extra = [n for n in names if n not in joint_names]
            also = f"; {', '.join(extra)} left out" if extra else ""
            notes.append(f"{JOINT_STATES}: joints come in another order and are put in the rig's by name{also}")
            break
    if short:
        notes.append(f"{JOINT_STATES}: left out {counted(short, 'message')} without a joint of the rig or a position")
    if found is not None and not np.isfinite(found.values).all():
        lost = ~np.isfinite(found.values)
        bad, of = lost.any(axis=1), ", ".join(np.array(joint_names)[lost.any(axis=0)][:3])
        samples = counted(int(bad.sum()), "sample")
        notes.append(f"{JOINT_STATES}: left out {samples} with a position that is no number (of {of})")
        found = Stream(found.stamp[~bad], found.values[~bad])
    return found


def _within(found: Stream | None, span: Span) -> Stream | None:
    if found is None:
        return None
    last = span.end if span.end is not None else int(found.stamp[-1])
    return found.between(span.begin, last)


def _attitude(message: Any) -> tuple[float, ...] | None:
    o = message.orientation
    valid = message.orientation_covariance[0] != -1 and (o.w, o.x, o.y, o.z) != (0.0, 0.0, 0.0, 0.0)
    return (o.w, o.x, o.y, o.z) if valid else None


def _angular_velocity(message: Any) -> tuple[float, ...] | None:
    v = message.angular_velocity
    return (v.x, v.y, v.z) if message.angular_velocity_covariance[0] != -1 else None


def _linear_acceleration(message: Any) -> tuple[float, ...] | None:
    a = message.linear_acceleration
    return (a.x, a.y, a.z) if message.linear_acceleration_covariance[0] != -1 else None


IMU_ROWS = {
    "attitude": _attitude,
    "angular_velocity": _angular_velocity,
    "linear_acceleration": _linear_acceleration,
}


def _position(message: Any) -> tuple[float, ...]:
    p = message.pose.position
    return (p.x, p.y, p.z)


def _along_heading(
    position: np.ndarray | None, recording: Recording, span: Span, scenario: Scenario, notes: list[str]
) -> np.ndarray | None:
    """(T, 3) positions turned, where the tracker's frame needs it, so that the robot begins along its scenario's
    heading: the way forward is counted along that."""
    poses = (r.message.pose for r in recording.records.get(TRACKER_POSE, []) if r.stamp >= span.begin)
    o = next((pose.orientation for pose in poses), None)
    seen = None if o is None else heading((o.x, o.y, o.z, o.w))
    if position is None or seen is None:
        return position
    angle = remainder(wanted_heading(scenario) - seen, 2 * pi)
    if abs(angle) < TURNED:
        return position
    notes.append(
        f"{TRACKER_POSE}: the robot heads {degrees(seen):.0f} degrees left of the tracker's x axis at its start; "
        f"positions are turned by {degrees(angle):.0f} degrees, so that the way counts along that heading"
    )
    return turned(position, angle)


def _feet(recording: Recording, rig: str) -> tuple[tuple[str, ...], Callable[[Any], Any | None]]:
    """The feet's names in order, and how a message gives their contacts (1 or 0)."""
    records = recording.records.get(FOOT_CONTACTS, [])
    foot_names = LEGS if rig == HEXAPOD else (tuple(records[0].message.name) if records else ())

    def row(message: Any) -> list[float] | None:
        by_name = dict(zip(message.name, message.contact, strict=False))
        return [float(by_name[name]) for name in foot_names] if set(foot_names) <= set(by_name) else None

    return foot_names, row


def _signal(
    recording: Recording,
    topic: str,
    row: Callable[[Any], Any | None],
    name: str,
    *,
    joints: Stream,
    span: Span,
    notes: list[str],
    gaps: list[tuple[str, float, float]],
) -> np.ndarray | None:
    """A topic's values at the joints' stamps, or None where there are too few."""
    found = stream(topic, recording.records.get(topic, []), row, notes)
    if found is None:
        return None
    covered = _covered(found, joints)
    if covered < LEAST_COVER:
        notes.append(f"{topic}: covers only {covered:.0%} of the rollout and is left out")
        return None
    missing = _missing(found, joints, span)
    _say_gaps(topic, missing, notes)
    gaps += [(name, gap.begin, gap.end) for gap in missing]
    if not np.isfinite(found.values).all():
        notes.append(f"{topic}: holds values that are no numbers; the signal is left out")
        return None
    return _at(found, joints.stamp, hold=topic == FOOT_CONTACTS, unit=row is _attitude)


def _covered(found: Stream, joints: Stream) -> float:
    """The share of the joints' samples that lie within the signal, or less than a tenth of a second beside it."""
    margin = round(GAP_S * 1e9)
    inside = (joints.stamp >= found.stamp[0] - margin) & (joints.stamp <= found.stamp[-1] + margin)
    return float(np.mean(inside))


def _at(found: Stream, stamp: np.ndarray, hold: bool, unit: bool) -> np.ndarray:
    """Rows at `stamp` (ns): the very values where the stamps agree."""
    last = np.clip(np.searchsorted(found.stamp, stamp, side="right") - 1, 0, len(found) - 1)
    values = found.values[last]
    between = found.stamp[last] != stamp
    if hold or not between.any():
        return values
    source = continuous(found.values) if unit else found.values
    origin = found.stamp[0]
    t, x = (stamp[between] - origin) * 1e-9, (found.stamp - origin) * 1e-9
    filled = np.stack([np.interp(t, x, column) for column in source.T], axis=-1)
    values = values.copy()
    values[between] = filled / np.linalg.norm(filled, axis=-1, keepdims=True) if unit else filled
    return values


def _missing(found: Stream, joints: Stream, span: Span) -> list[Gap]:
    """Where a signal stops for longer than it should while the joints were measured, at the begin and the end too."""
    edges = np.r_[joints.stamp[0], found.between(joints.stamp[0], joints.stamp[-1]).stamp, joints.stamp[-1]]
    time = (edges - span.begin) * 1e-9
    return [Gap(float(time[k]), float(time[k + 1])) for k in np.flatnonzero(np.diff(time) > _longest_step(found))]


def _longest_step(found: Stream) -> float:
    """The step (s) between two samples beyond which some are missing."""
    periods = GAP_PERIODS * float(np.median(np.diff(found.stamp))) * 1e-9 if len(found) > 1 else 0.0
    return max(GAP_S, periods)


def _say_gaps(name: str, gaps: list[Gap], notes: list[str]) -> None:
    if gaps:
        worst = max(gaps, key=lambda gap: gap.length)
        total = sum(gap.length for gap in gaps)
        notes.append(
            f"{name}: {len(gaps)} gap{'s' if len(gaps) > 1 else ''}, {total:.2f} s in all, the longest "
            f"{worst.length:.2f} s at {worst.begin:.2f} s; nothing is compared inside"
        )


def _say_late(joints: Stream, span: Span, notes: list[str]) -> None:
    late = (joints.stamp[0] - span.begin) * 1e-9
    if late > _longest_step(joints):
        notes.append(f"{JOINT_STATES}: begins {late:.2f} s after the rollout does; how it started is lost")


def _say_missing(recording: Recording, rig: str, notes: list[str]) -> None:
    if rig != HEXAPOD:
        return
    costs = {
        IMU: "attitude and body rates cannot be compared",
        FOOT_CONTACTS: "contacts cannot be compared",
        TRACKER_POSE: "the path cannot be compared; a distance comes from the END event alone",
    }
    notes += [f"no {topic}: {cost}" for topic, cost in costs.items() if not recording.records.get(topic)]
    readings = recording.records.get(IMU, [])
    if readings and all(_attitude(r.message) is None for r in readings):
        cost = "attitude, and the reward and the statistics that need it, cannot be compared"
        notes.append(f"{IMU}: no orientation, or one of zeros alone: {cost}")
