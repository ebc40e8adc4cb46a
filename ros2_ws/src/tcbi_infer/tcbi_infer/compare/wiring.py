"""Whether positions are what a rig's joints can do when asked: their unit, sign, and whose command they follow."""

import itertools
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.clocks import MOVES, Following, correlation
from tcbi_infer.compare.replicates import by_torque
from tcbi_infer.compare.signals import reference
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import load_rig, rig_names

SWAPPED = 0.7  # correlation of a joint with the command that it is said to follow; less comes about by chance
MIRRORED = -0.6  # correlation of a joint with its own command
LEAST_WIRING = 1.0  # s of motion that wiring is judged by
SAME = 1e-3  # rad within which positions only echo commands; no servo tracks a moving command so closely
ECHO_LAGS = np.arange(0.0, 0.105, 0.005)  # s
UNITS = {180 / np.pi: "degrees", 4096 / (2 * np.pi): "raw encoder counts", 1023 / np.radians(300): "raw encoder counts"}
STANDS = 0.2  # rad from zero, from which the sign of a joint that stands is seen
OPPOSITE = 0.25  # of a command, that a joint at the opposite of it may be off
SIGN = "its sign may be mirrored"
DROOP = 0.5  # share of its command that a joint at work still moves
BEYOND = 1.5  # of a rig's joint range, which no zero offset explains
RUSH = 5.0  # times the speed of a rig's joint without load
ALL_BUT_SPIKES = 0.99  # of the samples


def units(m: Measurement, following: Following) -> list[str]:
    largest = float(np.quantile(np.nan_to_num(np.abs(m.joint_position)).max(axis=1), ALL_BUT_SPIKES))
    if following.told:
        asked, seen = following.pairs(_found(following))
        slope = float(np.nanmedian(following.gain)) if np.isfinite(following.gain).any() else 1.0
        if following.off_unit:
            unit = next((name for k, name in UNITS.items() if DROOP < slope / k < 1.25), "another unit than radians")
            return [f"Joint positions move {slope:.0f} times as far as their commands: these look like {unit}"]
        if slope < 1 / 30 and np.median(np.abs(correlation(asked, seen))) > SWAPPED:
            return [f"Commands move {1 / slope:.0f} times as far as the joints: these look like degrees, not radians"]
    if largest > 30 * np.pi:
        return ["Joint positions reach hundreds of radians: these look like raw encoder counts or degrees"]
    turns = by_torque(m) or (following.told and slope > DROOP)  # a joint that may turn on, or was asked to
    if largest > 4 * np.pi and not turns:
        return ["Joint positions exceed two turns: these look like degrees, or an encoder that lost count"]
    return [] if m.rig not in rig_names() else _beyond_rig(m, largest, load_rig(m.rig))


def _beyond_rig(m: Measurement, largest: float, rig: Rig) -> list[str]:
    """Positions that the rig's servos cannot reach, or not as fast: commands may be in the same wrong unit."""
    if not by_torque(m) and rig.joint_range < np.pi and largest > BEYOND * rig.joint_range:
        return [
            f"Joint positions reach {largest:.3g} rad, and the rig's joints at most {rig.joint_range:.3g}: these look "
            "as if they had another unit than radians"
        ]
    speeds = np.nan_to_num(np.abs(np.gradient(m.joint_position, m.time, axis=0)))
    speed = float(np.quantile(speeds.max(axis=1), 0.9))
    if speed > RUSH * rig.speed_limit:
        return [
            f"The joints move at {speed:.3g} rad/s, and the rig's servos at most at {rig.speed_limit:.3g}: the "
            "positions look as if they had another unit than radians, or the times than seconds"
        ]
    return []


def _found(following: Following) -> float:
    lag = following.lag
    return lag if np.isfinite(lag) else 0.0


def echo(m: Measurement, following: Following) -> list[str]:
    """Positions that are only the commands again: as ramps or as steps, perhaps some samples late."""
    if not m.commands.time.size:
        return ["There are no commands in the recording, so nothing can be replayed"]
    if not following.told:
        return []
    seen = m.joint_position[:, following.joints]
    best = np.full(len(following.joints), np.inf)
    for lag in (lag for lag in ECHO_LAGS if following.known(lag).any()):
        known = following.known(lag)
        held = m.commands.target[np.clip(np.searchsorted(m.commands.time, m.time - lag + 1e-6) - 1, 0, None)]
        for asked in (following.asked(lag), held[:, following.joints]):
            best = np.minimum(best, np.quantile(np.abs(asked - seen)[known], 0.9, axis=0))
    echoes = [m.joint_names[j] for j, far in zip(following.joints, best, strict=True) if far < SAME]
    if not echoes:
        return []
    if len(echoes) == len(following.joints):
        return ["Joint positions are identical to the commands: the recording echoes commands, it measures nothing"]
    return [f"The positions of {', '.join(echoes)} are identical to their commands: these joints are not measured"]


def wiring(m: Measurement, following: Following) -> list[str]:
    """Mirrored joints move or stand against their command; swapped ones follow each other's."""
    if not following.told or following.seconds() < LEAST_WIRING:
        return []
    asked, seen = following.pairs(_found(following))
    follows = _follows(seen)
    names = [m.joint_names[j] for j in following.joints[follows]]
    opposite = _opposite(m)
    findings = [f"{name} stands at the opposite of its command: {SIGN}" for name in opposite if name not in names]
    if not names:
        return findings
    table = np.corrcoef(asked[:, follows].T, seen[:, follows].T).reshape(2 * len(names), -1)[: len(names), len(names) :]
    own = np.diag(table)
    findings += [
        f"{name} moves against its command: {SIGN}"
        for name, r in zip(names, own, strict=True)
        if (r < MIRRORED and np.isfinite(following.lag)) or (r < 0 and name in opposite)
    ]
    findings += [
        f"{names[a]} and {names[b]} follow each other's commands: they may be swapped"
        for a, b in itertools.combinations(range(len(names)), 2)
        if min(table[a, b], table[b, a]) > max(SWAPPED, max(own[a], own[b]) + 0.3)
    ]
    return findings


def unjudged(measurements: Sequence[Measurement]) -> tuple[str, ...]:
    """Joints whose wiring no rollout tells, of rollouts of one rig in which that of others is told."""
    told = [(m, f) for m, f in ((m, Following(m)) for m in measurements) if f.told and f.seconds() >= LEAST_WIRING]
    judged = {m.joint_names[j] for m, f in told for j in f.joints[_follows(f.pairs(_found(f))[1])]}
    return tuple(dict.fromkeys(name for m, _ in told for name in m.joint_names if name not in judged))


def _follows(seen: np.ndarray) -> np.ndarray:
    """(J,) which joints move enough to tell whose command they follow, of (N, J) rad."""
    return np.std(seen, axis=0) > MOVES / 2


def _opposite(m: Measurement) -> list[str]:
    """Joints that are where their command, with the other sign, would have them."""
    asked, seen = reference(m, m.time), m.joint_position
    far = np.nanmedian(np.abs(asked), axis=0)
    missed = np.nanmedian(np.abs(seen + asked), axis=0)
    return [m.joint_names[j] for j in np.flatnonzero((far > STANDS) & (missed < OPPOSITE * far))]
