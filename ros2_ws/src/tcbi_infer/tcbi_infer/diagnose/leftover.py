"""How much of what a model leaves unexplained goes with anything that was recorded, and with which variable.

The held-out residual of every joint's position is regressed on variables at the same moment: each by a smooth law of
its own (hat functions), all of them added up. A law is fitted to all kinds of motion but one and judged on that one;
how stiff it is, the other kinds decide in the same way. What such laws predict is the share that an effect unknown to
the library could explain: a robot may err by what depends on nothing recorded, and that is said, too.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.conditions import SLOW, read, torques
from tcbi_infer.compare.signals import DEGREE, JOINT, reference
from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.evidence import Leftover, Variable
from tcbi_infer.diagnose.heldout import fold_indices
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.rigs import load_rig

LEAST_KINDS = 3  # of motion: a law's stiffness is chosen among the others of the one that judges it
LEAST_SHARE = 0.1  # of the squared error beyond the noise: less is not called an explanation
KNOTS, FINE_KNOTS = 8, 48  # of a law; of a law of the position, which may repeat with every tooth of a gear
PENALTIES = (1.0, 5.0, 25.0, 125.0, 3000.0)  # 1: a law may be as large as the residual; the last allows next to nothing
OFFSET, TEETH = "a constant offset", "teeth"
COMMAND, POSITION = "the commanded position", "the predicted position"
LOAD, TORQUE = "the load (command less prediction)", "the commanded torque"


@dataclasses.dataclass(frozen=True)
class _Design:
    """Normal equations of every law, joint by joint, samples counted by their autocorrelation.

    Attributes:
      columns: name of a variable -> its columns.
      gram: (S, J, K, K); `slope` (S, J, K) against the residual in units of `scale`.
      scale: of the joints' residual, in noise floors.
      square: (S,) squared residual in noise floors, `noise` (S,) what of it is noise.
    """

    columns: dict[str, np.ndarray]
    gram: np.ndarray
    slope: np.ndarray
    scale: float
    square: np.ndarray
    noise: np.ndarray


def explain(problem: Problem, residual: np.ndarray, sets: np.ndarray, use: str = "") -> Leftover:
    """What a residual goes with.

    Args:
      problem: the data.
      residual: (open sets, T, C) each set predicted without its own kind of motion.
      sets: the open ones.
      use: the effect that the model has besides the base model, "" for none.
    """
    folds = fold_indices(problem, sets)
    if len(folds) < LEAST_KINDS:
        return Leftover(
            f"How much could be explained at all cannot be told from {len(folds)} kind{'s' * (len(folds) != 1)} of "
            f"motion: that needs {LEAST_KINDS}.",
            use,
        )
    joints = problem.replay.layout.where(JOINT)
    if not ((problem.weight[sets] > 0) & np.isfinite(residual))[..., joints].any():
        return Leftover("How much could be explained at all cannot be told: no motion held out was predicted.", use)
    design = _design(problem, residual, sets)
    excess = float(design.square.sum() - design.noise.sum())
    if excess <= LEAST_SHARE * design.noise.sum():
        return Leftover("The joints' error is down at the noise floor: nothing is left to explain.", use, 0.0)
    sizes = np.array([len(fold) for fold in folds])
    names = [name for name in design.columns if name != TEETH]
    offset = _predicted(design, [OFFSET], folds)
    variables = [_variable(OFFSET, offset, excess, sizes)]
    for name in names:
        if name != OFFSET:
            both = _predicted(design, [OFFSET, name], folds)
            variables.append(_variable(name, both - offset, excess, sizes))
    variables.sort(key=lambda v: -v.share)
    together = _variable("", _predicted(design, names, folds), excess, sizes)
    share = max([v.share for v in (together, *variables) if v.sure], default=0.0)
    return Leftover(_statement(share, variables), use, share, tuple(variables))


def _statement(share: float, variables: Sequence[Variable]) -> str:
    if not share:
        return (
            "Nothing recorded explains it, as far as these motions show: no law of what was recorded at the same "
            f"moment predicts the joints' errors in motions held out (tried: {', '.join(v.name for v in variables)})."
        )
    told = (
        f"Laws of what was recorded could explain {100 * share:.0f} % of the joints' squared error beyond the noise, "
        "judged on motions held out"
    )
    best = next((v for v in variables if v.sure), None)
    if best is None:
        return f"{told}; no single variable does."
    return f"{told}; {best.name} alone {100 * best.share:.0f} %."


def _variable(name: str, explained: np.ndarray, excess: float, sizes: np.ndarray) -> Variable:
    """From (F,) squared error that a law takes away in each kind of motion, in noise floors, and in nats of it."""
    share = float(explained[0].sum()) / excess
    se = float(np.std(explained[0], ddof=1) * np.sqrt(explained.shape[1])) / excess
    certain = paired.statistic(explained[1], sizes) > paired.limit(len(sizes))
    return Variable(name, float(np.clip(share, 0.0, 1.0)), se, bool(certain and share >= LEAST_SHARE))


def _predicted(design: _Design, names: Sequence[str], folds: Sequence[np.ndarray]) -> np.ndarray:
    """(2, F) squared error that laws of some variables take away in each kind of motion: in noise floors, in nats.

    How stiff the laws are, whether each joint has its own, and whether that of the position may have teeth, is what
    served the other kinds best.
    """
    teeth = design.columns[TEETH] if POSITION in names else np.zeros(0, int)
    chosen = np.concatenate([*(design.columns[name] for name in names), teeth])
    smooth, every = np.arange(len(chosen) - len(teeth)), range(len(folds))
    finer = [np.arange(len(chosen))] if len(teeth) else []
    gram = np.stack([design.gram[fold].sum(axis=0) for fold in folds])[..., chosen[:, None], chosen]
    slope = np.stack([design.slope[fold].sum(axis=0) for fold in folds])[..., chosen]

    def gained(law: np.ndarray, fold: int) -> np.ndarray:
        return (law * (2.0 * slope[fold] - (gram[fold] @ law[..., None])[..., 0])).sum(axis=-1)

    def fitted(without: set[int], columns: np.ndarray, shared: bool, penalty: float) -> np.ndarray:
        train = [f for f in every if f not in without]
        matrix, right = gram[train].sum(axis=0)[:, columns[:, None], columns], slope[train].sum(axis=0)[:, columns]
        if shared:
            matrix, right = matrix.sum(axis=0, keepdims=True), right.sum(axis=0, keepdims=True)
        law = np.zeros(slope[0].shape)
        law[:, columns] = np.linalg.solve(matrix + penalty * np.eye(len(columns)), right[..., None])[..., 0]
        return law

    ways = list(itertools.product([smooth, *finer], {False, gram.shape[1] > 1}, PENALTIES))
    tried = np.zeros((len(folds), len(ways)))  # of each kind left out: what the others predict of each other
    for f, g in itertools.combinations(every, 2):
        for i, way in enumerate(ways):
            law = fitted({f, g}, *way)
            tried[f, i] += gained(law, g).sum()
            tried[g, i] += gained(law, f).sum()
    result = np.empty((2, len(folds)))
    for f in every:
        gain = gained(fitted({f}, *ways[int(np.argmax(tried[f]))]), f)
        result[:, f] = (gain * design.scale**2).sum(), 0.5 * gain.sum()
    return result


def _design(problem: Problem, residual: np.ndarray, sets: np.ndarray) -> _Design:
    joints = problem.replay.layout.where(JOINT)
    index = joints[problem.weight[sets][..., joints].any(axis=(0, 1))]
    weight = problem.weight[sets][..., index]
    scaled = residual[..., index] / problem.floor[index]
    predicted = np.where(weight > 0, problem.observed[sets][..., index] - residual[..., index], np.nan)
    laws = _laws(problem, predicted, sets, [int(np.flatnonzero(joints == i)[0]) for i in index])
    weight = weight * np.isfinite(scaled) * np.all([np.isfinite(law).all(axis=-1) for law in laws.values()], axis=0)
    scaled = np.where(weight > 0, scaled, 0.0)
    scale = float(np.sqrt((scaled**2).sum() / weight.sum()))
    columns, first = {}, 0
    for name, law in laws.items():
        columns[name] = np.arange(first, first + law.shape[-1])
        first += law.shape[-1]
    share = problem.share[problem.group[index[0]]]
    gram, slope = np.empty((len(sets), len(index), first, first)), np.empty((len(sets), len(index), first))
    for s in range(len(sets)):
        each = np.concatenate([np.nan_to_num(law[s]) for law in laws.values()], axis=-1)  # (T, J, K)
        weighted = (share * weight[s][..., None] * each).transpose(1, 2, 0)
        gram[s] = weighted @ each.transpose(1, 0, 2)
        slope[s] = np.einsum("jkt,tj->jk", weighted, scaled[s] / scale)
    repeats = np.maximum(problem.replay.counts()[sets][..., index], 1)
    noise = (weight / repeats).sum(axis=(1, 2))
    # the sums of gains count independent samples, those of squares all of them
    return _Design(columns, gram, slope, scale / np.sqrt(share), (scaled**2).sum(axis=(1, 2)), noise)


def _joined(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(S, T, J) with straight lines across what does not count, as between the readings of a slow recording."""
    result = values.copy()
    for s, j in np.ndindex(values.shape[0], values.shape[2]):
        known = np.flatnonzero(np.isfinite(values[s, :, j]))
        if len(known):
            within = slice(known[0], known[-1] + 1)
            result[s, within, j] = np.interp(time[within], time[known], values[s, known, j])
    return result


def _laws(problem: Problem, predicted: np.ndarray, sets: np.ndarray, joints: list[int]) -> dict[str, np.ndarray]:
    """Name -> (S, T, J, K) columns of each variable that varies, centred, of about unit size.

    Args:
      problem: the data.
      predicted: (S, T, J) joint positions in degrees, NaN where nothing counts.
      sets: the open ones.
      joints: of the robot, that count.
    """
    replay = problem.replay
    firsts = [replay.measurements[replay.replicates[s].members[0]] for s in sets]
    time, shape = replay.time, predicted.shape
    velocity = np.gradient(_joined(predicted, time), time, axis=1)
    smooth = {POSITION: predicted, "the predicted velocity": velocity}
    if load_rig(replay.rig).kind == "position":
        asked = np.stack([reference(m, time)[:, joints] for m in firsts]) * DEGREE
        smooth = {COMMAND: asked, **smooth, LOAD: asked - predicted}
        smooth["the commanded speed"] = np.gradient(asked, time, axis=1)
    else:
        smooth[TORQUE] = np.stack([torques(m, time)[:, joints] for m in firsts])
    smooth["the time since start"] = np.broadcast_to(time[None, :, None], shape)
    laws = {OFFSET: np.ones((*shape, 1))}
    for name, values in smooth.items():
        if np.nanmax(np.nanmax(values, axis=(0, 1)) - np.nanmin(values, axis=(0, 1))) > 1e-9:
            laws[name] = _hats(values, KNOTS, own=name in (COMMAND, POSITION))
    for reading in read(firsts, time):
        own = dataclasses.replace(reading, values=reading.values[..., joints])
        if own.varies:  # where nothing was read, the law says nothing
            laws[f"the measured {own.name}"] = np.nan_to_num(_hats(own.values, KNOTS, own=False))
    if POSITION in laws:
        laws[TEETH] = _hats(predicted, FINE_KNOTS, own=True)
    laws["the direction of motion"] = np.tanh(velocity / (SLOW * DEGREE))[..., None]
    for name, values in {
        "the slope": np.array([(m.scenario.slope_roll, m.scenario.slope_pitch) for m in firsts]),
        **{f"the recorded {key}": column[:, None] for key, column in _constants(problem, sets).items()},
    }.items():
        spread = values.std(axis=0)
        if (spread > 1e-9).any():
            each = (values - values.mean(axis=0))[:, spread > 1e-9] / spread[spread > 1e-9]
            laws[name] = np.broadcast_to(each[:, None, None], (*shape, each.shape[-1]))
    return laws


def _constants(problem: Problem, sets: np.ndarray) -> dict[str, np.ndarray]:
    """(S,) numbers that every rollout states of itself, such as a supply voltage or a temperature."""
    replay = problem.replay
    each = [dict(replay.measurements[replay.replicates[s].members[0]].scenario.constants) for s in sets]
    shared = set.intersection(*(set(constants) for constants in each))
    return {key: np.array([constants[key] for constants in each]) for key in sorted(shared)}


def _hats(values: np.ndarray, knots: int, own: bool) -> np.ndarray:
    """(S, T, J, knots + 1) a line and hat functions over each joint's own range or that of all; NaN where `values` are.

    All are centred, and the line has unit size.
    """
    low, high = np.nanquantile(values, (0.005, 0.995), axis=(0, 1) if own else None)
    place = np.clip((values - low) / np.maximum(high - low, 1e-9), 0.0, 1.0)
    hats = np.maximum(0.0, 1.0 - np.abs(place[..., None] * (knots - 1) - np.arange(knots)))
    columns = np.concatenate([place[..., None] * np.sqrt(12.0), hats], axis=-1)
    return columns - np.nanmean(columns, axis=(0, 1) if own else (0, 1, 2))
