"""Whether positions are what a rig's joints can do when asked: their unit, sign, and whose command they follow."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from tcbi_infer.compare.clocks import MOVES, Following, correlation
from tcbi_infer.compare.replicates import by_torque
from tcbi_infer.compare.signals import reference
from tcbi_infer.spikes import without_spikes
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import load_rig, rig_names

SWAPPED = 0.7  # correlation of a joint with the command that it is said to follow; less comes about by chance
APART = 0.3  # by which that must be more than with its own
FEW, SHOWN = 3, 6  # findings of one sort that are told each; joints shown of many
MIRRORED = -0.6  # correlation of a joint with its own command
SERVO_LAGS = (0.05, 0.1, 0.15)  # s
LEAST_WIRING = 1.0  # s of motion that wiring is judged by
SAME = 1e-3  # rad within which positions only echo commands; no servo tracks a moving command so closely
ECHO_LAGS, CLOSER = np.arange(0.0, 0.105, 0.005), np.arange(-0.004, 0.0045, 0.001)  # s
UNITS = {180 / np.pi: "degrees", 4096 / (2 * np.pi): "raw encoder counts", 1023 / np.radians(300): "raw encoder counts"}
STANDS = 0.2  # rad from zero, from which the sign of a joint that stands is seen
OPPOSITE = 0.25  # of a command, that a joint at the opposite of it may be off
SIGN = "its sign may be mirrored"
COMMANDED = 1 / 30  # share of its command that any joint moves
DROOP = 0.5  # share of its command that a joint at work still moves
BEYOND = 1.5  # of a rig's joint range, which no zero offset explains
WRAP = 0.3  # rad from a whole turn, of a jump between two samples that is one
SMOOTH = 1.0  # rad between two samples, that a joint's other readings stay below
RUSH = 5.0  # times the speed of a rig's joint without load
ALL_BUT_SPIKES = 0.99  # of the samples


def units(m: Measurement, following: Following) -> list[str]:
    """Findings of positions or commands that are not in rad, or that jump by whole turns."""
    if wrapped := _wrapped(m):
        return wrapped
    largest = float(np.quantile(np.nan_to_num(np.abs(m.joint_position)).max(axis=1), ALL_BUT_SPIKES))
    slope = float(np.nanmedian(following.gain)) if following.told and np.isfinite(following.gain).any() else 1.0
    if following.off_unit:
        return [_off_unit(slope)]
    if following.told:
        asked, seen = following.pairs(_found(following))
        if slope < COMMANDED and np.median(np.abs(correlation(asked, seen))) > SWAPPED:
            times = f"over {1 / COMMANDED:.0f} times"
            return [f"Commands move {times} as far as the joints: these look like degrees, not radians"]
    else:  # commands that hardly move, as those in rad do that were taken for degrees
        tiny = Following(m, MOVES * COMMANDED)
        if tiny.off_unit and np.median(np.abs(correlation(*tiny.pairs(_found(tiny))))) > SWAPPED:
            return [_off_unit(float(np.nanmedian(tiny.gain)))]
    if largest > 30 * np.pi:
        return ["Joint positions reach hundreds of radians: these look like raw encoder counts or degrees"]
    turns = by_torque(m) or (following.told and slope > DROOP)  # a joint that may turn on, or was asked to
    if largest > 4 * np.pi and not turns:
        return ["Joint positions exceed two turns: these look like degrees, or an encoder that lost count"]
    return [] if m.rig not in rig_names() else _beyond_rig(m, largest, load_rig(m.rig))


def _wrapped(m: Measurement) -> list[str]:
    jumps = np.nan_to_num(np.abs(np.diff(m.joint_position, axis=0)))
    turns = np.abs(jumps - 2 * np.pi) < WRAP
    smooth = np.where(turns, 0.0, jumps).max(axis=0, initial=0.0) < SMOOTH
    found = []
    for j in np.flatnonzero(turns.any(axis=0) & smooth):
        at = m.time[1 + int(np.argmax(turns[:, j]))]
        found.append(
            f"{m.joint_names[j]} jumps by a whole turn at {at:.2f} s: its reading wrapped round; unwrap the log "
            "(numpy.unwrap) and import it again"
        )
    return found


def _off_unit(slope: float) -> str:
    near = ((k, name) for k, name in UNITS.items() if DROOP < slope / k < 1.25)
    times, unit = next(near, (slope, "another unit than radians"))  # the unit's own: the same in every rollout
    return (
        f"Joint positions move some {times:.0f} times as far as their commands: these look like {unit}, or the "
        "commands were scaled as if they were"
    )


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
    rough = _off(m, following, seen, ECHO_LAGS)
    near = ECHO_LAGS[int(np.argmin(np.median(rough, axis=1)))] + CLOSER
    best = np.min([*rough, *_off(m, following, seen, near[near >= 0])], axis=0)
    echoes = [m.joint_names[j] for j, far in zip(following.joints, best, strict=True) if far < SAME]
    if not echoes:
        return []
    if len(echoes) == len(following.joints):
        return ["Joint positions are identical to the commands: the recording echoes commands, it measures nothing"]
    return [f"The positions of {', '.join(echoes)} are identical to their commands: these joints are not measured"]


def _off(m: Measurement, following: Following, seen: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """(L, moving joints) rad by which positions differ from the commands of (L,) s ago, as ramps or as steps."""
    ramps = reference(m, np.concatenate([m.time - lag for lag in lags]))[:, following.joints]
    off = np.full((len(lags), len(following.joints)), np.inf)
    for k, (lag, ramp) in enumerate(zip(lags, np.split(ramps, len(lags)), strict=True)):
        known = following.known(lag)
        held = m.commands.target[np.clip(np.searchsorted(m.commands.time, m.time - lag + 1e-6) - 1, 0, None)]
        for asked in (ramp, held[:, following.joints]) if known.any() else ():
            off[k] = np.minimum(off[k], np.quantile(np.abs(asked - seen)[known], 0.9, axis=0))
    return off


def wiring(measurements: Sequence[Measurement], followings: Sequence[Following]) -> list[str]:
    """Mirrored joints move or stand against their command; swapped ones follow each other's. All rollouts together: one
    motion tells some joints apart, the next one others."""
    groups: dict[tuple[str, ...], list[tuple[Measurement, Following]]] = {}
    for m, following in zip(measurements, followings, strict=True):
        if following.told:
            groups.setdefault(m.joint_names, []).append((m, following))
    return [
        finding
        for names, told in groups.items()
        if sum(following.seconds() for _, following in told) >= LEAST_WIRING
        for finding in _wiring(names, told)
    ]


def _wiring(names: Sequence[str], told: Sequence[tuple[Measurement, Following]]) -> list[str]:
    followings = [following for _, following in told]
    table, moves = _table(len(names), followings)
    own, opposite = np.diag(table), _opposite([m for m, _ in told])
    against = own < MIRRORED
    if not any(np.isfinite(following.lag) for following in followings):  # a joint that comes late enough seems to
        others = [np.diag(_table(len(names), followings, lag)[0]) for lag in SERVO_LAGS]
        against &= np.max(others, axis=0) < 0
    mirrored = moves & (against | (opposite & (own < 0)))
    stand = [
        f"{names[j]} stands at the opposite of its command: {SIGN}" for j in map(int, np.flatnonzero(opposite & ~moves))
    ]
    return stand + _against([names[int(j)] for j in np.flatnonzero(mirrored)]) + _order(names, table, moves, mirrored)


def _table(count: int, followings: Sequence[Following], lag: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(J, J) correlation of each command with each joint, and (J,) which joints move enough to be judged.

    At a lag (s), or at that which was found.
    """
    products, of_commands, of_joints = np.zeros((3, count, count))
    squares, samples = np.zeros(count), np.zeros(count)
    for following in followings:
        here = np.ix_(following.joints, following.joints)
        asked, seen = (
            values - values.mean(axis=0) for values in following.pairs(_found(following) if lag is None else lag)
        )
        products[here] += asked.T @ seen
        of_commands[here] += (asked**2).sum(axis=0)[:, None]
        of_joints[here] += (seen**2).sum(axis=0)[None]
        squares[following.joints] += (seen**2).sum(axis=0)
        samples[following.joints] += len(seen)
    table = products / np.sqrt(np.maximum(of_commands * of_joints, 1e-12))
    return table, np.sqrt(squares / np.maximum(samples, 1)) > MOVES / 2


def _against(names: Sequence[str]) -> list[str]:
    """A sentence for each of a few mirrored joints, one for many."""
    if len(names) <= FEW:
        return [f"{name} moves against its command: {SIGN}" for name in names]
    return [f"{len(names)} joints move against their commands ({_some(names)}): their signs may be mirrored"]


def _order(names: Sequence[str], table: np.ndarray, moves: np.ndarray, mirrored: np.ndarray) -> list[str]:
    """Joints that follow the command of another one, as one order of all explains it best."""
    alike = np.where(mirrored, -table, table)[np.ix_(moves, moves)]
    who, own = [names[int(j)] for j in np.flatnonzero(moves)], np.diag(alike)
    pairs = zip(*linear_sum_assignment(-alike), strict=True)
    follows = {int(b): int(a) for a, b in pairs if a != b and alike[a, b] > max(SWAPPED, own[b] + APART)}
    if len(follows) < 2:
        return []
    swapped = [(a, b) for b, a in follows.items() if follows.get(a) == b and a < b]
    if 2 * len(swapped) == len(follows) and len(swapped) <= FEW:
        return [f"{who[a]} and {who[b]} follow each other's commands: they may be swapped" for a, b in swapped]
    told = _some([f"{who[b]} the command of {who[a]}" for b, a in follows.items()])
    return [f"{len(follows)} joints follow other joints' commands ({told}): their columns may stand in another order"]


def _some(of: Sequence[str]) -> str:
    return ", ".join(of[:SHOWN]) + (f" and {len(of) - SHOWN} more" if len(of) > SHOWN else "")


def unjudged(measurements: Sequence[Measurement]) -> tuple[str, ...]:
    """Joints whose wiring no rollout tells, of rollouts of one rig in which that of others is told."""
    pairs = [(m, Following(m)) for m in map(without_spikes, measurements)]
    told = [(m, f) for m, f in pairs if f.told and f.seconds() >= LEAST_WIRING]
    judged = {m.joint_names[j] for m, f in told for j in f.joints[_follows(f.pairs(_found(f))[1])]}
    return tuple(dict.fromkeys(name for m, _ in told for name in m.joint_names if name not in judged))


def _follows(seen: np.ndarray) -> np.ndarray:
    """(J,) which joints move enough to tell whose command they follow, of (N, J) rad."""
    return np.std(seen, axis=0) > MOVES / 2


def _opposite(measurements: Sequence[Measurement]) -> np.ndarray:
    """(J,) which joints are where their command, with the other sign, would have them."""
    asked = np.concatenate([reference(m, m.time) for m in measurements])
    seen = np.concatenate([m.joint_position for m in measurements])
    far = np.nanmedian(np.abs(asked), axis=0)
    missed = np.nanmedian(np.abs(seen + asked), axis=0)
    return (far > STANDS) & (missed < OPPOSITE * far)
