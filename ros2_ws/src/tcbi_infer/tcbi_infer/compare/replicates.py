"""Which rollouts repeat each other, which make a kind of motion, and which stay sealed.

The unit of evidence is never the sample. Rollouts of one source (the robot, or a simulation) with the same commands
and scenario are replicates: their differences are the noise floor, and they count as one observation of the model's
error. Replicates never straddle a split.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.rigs import load_rig, rig_names

SAME_TARGET = 2e-3  # rad
SAME_TORQUE = 0.01  # of the torques' spread: motors differ far in what they can give
SAME_START = 0.02  # rad; a robot that is put down again does not stand closer to where it stood
SAME_SLOPE = 2e-3  # rad
SAME_SPEED = 0.05  # rad/s; a start in motion is measured no better
SAME_TIME = 0.1  # s, jitter of a live command stream; half a control period
NEARLY = 5.0  # times such a tolerance: who asked for the same came no further from it by accident
SAME_SHAPE = 0.1  # of a motion's spread
MOVES = 0.02  # rad, standard deviation of a beginning that tells one motion from another
MIN_KINDS = 5  # of fewer kinds no false-alarm rate is told
SURE_KINDS = 6  # with which false alarms can be held at 5 % (tcbi_infer.diagnose.paired.level)
SCRIPTED = "gait:"  # begins the name of a policy that is known to act without feedback


@dataclasses.dataclass(frozen=True)
class Replicates:
    """Rollouts that were asked for the same thing.

    Attributes:
      members: indices into the list of measurements.
      kind: number of the kind of motion that it belongs to.
    """

    members: tuple[int, ...]
    kind: int


@dataclasses.dataclass(frozen=True)
class Split:
    """Replicate sets by use: `folds` are held out in turn, `sealed` is kept from fits and searches, for the verdict."""

    folds: tuple[tuple[int, ...], ...]
    sealed: tuple[int, ...]

    @property
    def open(self) -> tuple[int, ...]:
        """All replicate sets that fits may see."""
        return tuple(i for fold in self.folds for i in fold)


def same_scenario(a: Scenario, b: Scenario, torque: bool = False) -> bool:
    """Whether two rollouts took place in the same surroundings, from the same start.

    Args:
      a: one rollout's.
      b: the other's.
      torque: of joints that are moved by torques, which a start goes with all the way; servos leave it behind.
    """
    return _same_but_for_measures(a, b) and all(apart < most for _, apart, most, _ in _apart(a, b, torque))


def _same_but_for_measures(a: Scenario, b: Scenario) -> bool:
    """Whether what is not measured is the same of two scenarios, seeds and durations aside."""
    near: dict[str, Any] = {"initial_joint_position": None, "initial_joint_velocity": None}
    near |= {"slope_roll": 0.0, "slope_pitch": 0.0, "seed": 0, "duration": 0.0}
    return dataclasses.replace(a, **near) == dataclasses.replace(b, **near)


def _apart(a: Scenario, b: Scenario, torque: bool) -> list[tuple[str, float, float, str]]:
    """In what two scenarios may differ a little: what it is, how far they lie apart in it, the tolerance, its unit."""
    slopes = [(s.slope_roll, s.slope_pitch) for s in (a, b)]
    starts = _between(a.initial_joint_position, b.initial_joint_position)
    speeds = _between(a.initial_joint_velocity, b.initial_joint_velocity)
    return [
        ("the slope", _between(*slopes), SAME_SLOPE, "rad"),
        ("the start of a joint", starts, SAME_TARGET if torque else SAME_START, "rad"),
        ("a joint's speed at the start", speeds, SAME_SPEED, "rad/s"),
    ]


def _between(a: tuple[float, ...] | None, b: tuple[float, ...] | None) -> float:
    """The largest difference of two starts; None is zero everywhere."""
    first, second = (np.zeros(1) if start is None else np.array(start) for start in (a, b))
    return float(np.abs(first - second).max())


def by_torque(m: Measurement) -> bool:
    """Whether the commands are torques, which no joint position follows."""
    return m.rig in rig_names() and load_rig(m.rig).kind == "torque"


def same_commands(a: Commands, b: Commands, torque: bool = False) -> bool:
    """Whether two command streams are the same up to the jitter of a live stream.

    Args:
      a: one stream.
      b: the other one.
      torque: their targets are N m, else rad.
    """
    same = a.target.shape == b.target.shape and _same_targets(a, b, torque)
    return same and bool(np.all(np.abs(a.time - b.time) < SAME_TIME))


def _same_targets(a: Commands, b: Commands, torque: bool) -> bool:
    """Whether as many commands ask for the same, whenever they do."""
    if a.target.shape != b.target.shape or abs(a.ramp - b.ramp) >= 1e-6:
        return False
    most = SAME_TORQUE * float(np.std(a.target)) if torque else SAME_TARGET
    return bool(np.all(np.abs(a.target - b.target) <= most))


def nearly_repeats(a: Measurement, b: Measurement) -> str:
    """What keeps two rollouts that seem to ask for the same from being repeats, or ""."""
    first, second, torque = a.commands, b.commands, by_torque(a)
    short, long = sorted((first, second), key=lambda c: len(c.time))
    n = len(short.time)
    beginning = dataclasses.replace(long, time=long.time[:n], target=long.target[:n])
    if not _same_but_for_measures(a.scenario, b.scenario) or a.source != b.source or not n or 2 * n < len(long.time):
        return ""
    if not _same_targets(short, beginning, torque):
        return ""
    differ = _apart(a.scenario, b.scenario, torque)
    differ.append(("the time of a command", float(np.abs(short.time - beginning.time).max()), SAME_TIME, "s"))
    if any(apart >= NEARLY * most for _, apart, most, _ in differ):
        return ""
    said = [f"{what} by {apart:.2g} {unit} (allowed {most:g})" for what, apart, most, unit in differ if apart >= most]
    if n < len(long.time):
        said.append(f"the number of commands ({len(first.time)} and {len(second.time)})")
    return ", ".join(said)


def repeats(measurements: Sequence[Measurement]) -> list[list[int]]:
    """Which rollouts were asked for the same thing, as positions, in the order of their first member."""
    groups: list[list[int]] = []
    for i, m in enumerate(measurements):
        torque = by_torque(m)
        for group in groups:
            first = measurements[group[0]]
            alike = same_scenario(first.scenario, m.scenario, torque) and first.source == m.source
            if alike and same_commands(first.commands, m.commands, torque):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def find_replicates(measurements: Sequence[Measurement]) -> list[Replicates]:
    """Groups rollouts into replicate sets, in the order of their first member."""
    groups = repeats(measurements)
    labels = [_label(measurements[g[0]]) for g in groups]
    distinct = list(dict.fromkeys(labels))
    by_shape = _kinds_by_shape(measurements, groups)
    if len(distinct) >= MIN_KINDS:
        kinds = _either([distinct.index(label) for label in labels], by_shape)
    else:
        kinds = _joined(by_shape, labels)
    return [Replicates(tuple(g), kind) for g, kind in zip(groups, kinds, strict=True)]


def _label(measurement: Measurement) -> tuple[str, str]:
    return (measurement.scenario.task, measurement.policy_id)


def _either(first: Sequence[int], second: Sequence[int]) -> list[int]:
    """Kinds of what is alike by either of two sortings: policies of two names may ask for the same motion."""
    kinds = list(first)
    for group in set(second):
        joined = {kind for kind, other in zip(kinds, second, strict=True) if other == group}
        kinds = [min(joined) if kind in joined else kind for kind in kinds]
    distinct = list(dict.fromkeys(kinds))
    return [distinct.index(kind) for kind in kinds]


def _joined(kinds: Sequence[int], labels: Sequence[tuple[str, str]]) -> list[int]:
    """The kinds, those in which one closed-loop policy did one task made one.

    Its commands answer to the robot, so their shapes differ from one rollout to the next though the motion, and what a
    model gets wrong of it, is the same.
    """
    for label in dict.fromkeys(labels):
        if label[1] and not label[1].startswith(SCRIPTED):
            own = {kind for kind, other in zip(kinds, labels, strict=True) if other == label}
            kinds = [min(own) if kind in own else kind for kind in kinds]
    distinct = list(dict.fromkeys(kinds))
    return [distinct.index(kind) for kind in kinds]


def _kinds_by_shape(measurements: Sequence[Measurement], groups: Sequence[Sequence[int]]) -> list[int]:
    """Kinds where policies do not tell them apart: the same commanded motion is one kind, whatever else differs.

    So are pieces of one recording, which begin while it moves and bear its name for a policy.
    """
    firsts: list[Measurement] = []
    kinds = []
    for group in groups:
        m = measurements[group[0]]
        for k, first in enumerate(firsts):
            pieces = _is_piece(first) and _is_piece(m)
            same = first.policy_id == m.policy_id if pieces else same_motion(first.commands, m.commands, by_torque(m))
            if same:
                kinds.append(k)
                break
        else:
            kinds.append(len(firsts))
            firsts.append(m)
    return kinds


def _is_piece(m: Measurement) -> bool:
    return m.scenario.initial_joint_velocity is not None and bool(m.policy_id)


def same_motion(a: Commands, b: Commands, torque: bool = False, rate: float = 50.0) -> bool:
    """Whether two command streams ask for nearly the same motion, however they were sampled.

    What they differ by is held against how far joints move, each about its own mean, whatever the posture. Of different
    length, they do if the beginning that both have moves, and is the same.

    Args:
      a: one stream.
      b: the other one.
      torque: their targets are N m, else rad.
      rate: Hz at which they are compared.
    """
    if not len(a.time) or not len(b.time) or a.target.shape[1] != b.target.shape[1]:
        return False
    end = min(a.time[-1], b.time[-1])
    cut = max(a.time[-1], b.time[-1]) > 1.2 * end + 0.5
    grid = np.arange(0.0, max(end, 1.0 / rate), 1.0 / rate)
    first, second = (_held(c, grid) for c in (a, b))
    spread = max(float(np.sqrt(np.var(first, axis=0).mean())), 0.0 if torque else SAME_TARGET)
    moves = float(np.std(first, axis=0).max())
    if cut and moves <= (0.0 if torque else MOVES):
        return False
    return bool(np.sqrt(np.mean((first - second) ** 2)) <= SAME_SHAPE * spread)


def _held(commands: Commands, grid: np.ndarray) -> np.ndarray:
    """(T, J) the last target at each time of the grid."""
    return commands.target[np.clip(np.searchsorted(commands.time, grid, side="right") - 1, 0, None)]


def split(replicates: Sequence[Replicates], seed: int = 0, sealed_share: float = 0.2) -> Split:
    """Folds of whole kinds of motion, and a sealed part where there are kinds beyond those that a 5 % claim needs.

    Where nothing is sealed, the figures are cross-validated only, which the report says.
    """
    kinds = sorted({r.kind for r in replicates})
    order = list(np.random.default_rng(seed).permutation(kinds))
    wanted = max(round(sealed_share * len(kinds)), 1) if sealed_share > 0 else 0
    count = min(wanted, max(len(kinds) - SURE_KINDS, 0))
    sealed_kinds = set(order[:count])
    folds = tuple(
        tuple(i for i, r in enumerate(replicates) if r.kind == kind) for kind in kinds if kind not in sealed_kinds
    )
    return Split(folds, tuple(i for i, r in enumerate(replicates) if r.kind in sealed_kinds))
