"""Does the robot move as the model does with any parameters? What histograms cannot see: the order of events in time.

A servo that answers late, or slowly because its torque is limited, leaves nearly the histogram of a softer one. So the
recorded commands are replayed with draws of the posterior, and joints and attitude are followed through time. The
mixture of draws that comes nearest to the robot (an affine one, whose weights a ridge holds back) says which parameters
would move most like it. More draws are simulated close to these, whose servos differ from one another as servos of one
make do. If the robot were one more of them, the nearest mixture would miss it by as much as it misses any of them that
is left out. Where it misses more, and less with every look, the look is repeated closer to the robot. This is a
posterior predictive check (Gelman, Meng and Stern 1996) that a wide posterior does not blunt: close to the best
parameters draws differ by little.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.problem import Problem, Simulated
from tcbi_infer.tcbi.servos import draw_scales, simulate_with
from tcbi_infer.tcbi.weights import normalised, resample

DRAWS = 48  # of the posterior: about a generation's simulations
LEAST_DRAWS = 8  # of which less is no measure of how far apart they lie
CLOSE_DRAWS = 8  # about the best mixture, for each parameter
CLOSE = 0.06  # their standard deviation, in shares of a parameter's range
RIDGE = 0.1  # of the draws' mean variance: holds weights back that would follow noise
JOINTS, TILTS = "joint positions", "roll and pitch"
# times as much as each other's, that predictions miss the robot's motion: where the model is wrong
DEPARTED = {JOINTS: 2.0, TILTS: 4.0}
# rad: missing less is of no account, however much it stands out; about what the encoders of small servos resolve
NEGLIGIBLE = {JOINTS: 0.006, TILTS: 0.0045}
ROUNDS = 4  # at most, in which draws are simulated ever closer to the best mixture while that misses too much
CLOSER = 0.8  # of what was missed, at most, for a further round


class Departure(NamedTuple):
    """How far a robot's signal is from the model's; `missed` and `apart` are about 1 or less where nothing is wrong."""

    missed: float  # by the nearest mixture of predictions, in times by how much they miss each other
    apart: float  # from the posterior's nearest draw, in times how far the draws lie from each other
    error: float  # rad, root mean square of what that mixture misses
    rollouts: tuple[float, ...]  # `missed` of each rollout, by the mixture that is nearest to all of them


class Departures(NamedTuple):
    """What the check found, and what it cost."""

    signals: dict[str, Departure]  # that were measured; empty if too few simulations ended well
    particles: int  # simulated for it
    nearest: tuple[float, ...] = ()  # (P,) of the mixture of posterior draws that comes nearest; beyond 0 and 1, too
    each: tuple[tuple[float, ...], ...] = ()  # (R, P) the same for each rollout alone

    @property
    def far(self) -> dict[str, Departure]:
        """The signals in which the model moves otherwise than the robot."""
        return {name: d for name, d in self.signals.items() if _is_far(name, d)}


class _Traces(NamedTuple):
    """How far N simulations lie from the robot, group by group; rad, float32 (a rollout of 30 s has many samples)."""

    joint_position: tuple[np.ndarray, ...]  # (N, S, T, J) each
    roll_pitch: tuple[np.ndarray, ...]  # (N, S, T, 2) each; none where an attitude was not measured
    valid: np.ndarray  # (N,) bool, False where the simulation diverged

    def join(self, other: "_Traces") -> "_Traces":
        """Both sets of particles, these first."""
        joints = zip(self.joint_position, other.joint_position, strict=True)
        tilts = zip(self.roll_pitch, other.roll_pitch, strict=True)
        return _Traces(
            tuple(map(np.concatenate, joints)), tuple(map(np.concatenate, tilts)),
            np.concatenate([self.valid, other.valid]),
        )  # fmt: skip

    def products(self) -> dict[str, np.ndarray]:
        """(R, V, V) for each signal, rad^2: mean products of what V valid simulations differ from each rollout.

        Their sum over R rollouts is that of the mean products over all of them: a longer rollout weighs more.
        """
        signals = {JOINTS: self.joint_position, TILTS: self.roll_pitch}
        return {name: _products(groups, self.valid) for name, groups in signals.items() if groups}


def departures(problem: Problem, unit: np.ndarray, log_weights: np.ndarray) -> Departures:
    """How much more than each other's motion the model's predictions miss the robot's.

    Args:
      problem: the real rollouts; their policies do not act here, so that a deviation stays where it arises.
      unit: (M, P) particles in the parameters' unit cube.
      log_weights: (M,).

    Returns:
      For each signal that was measured ratios of root mean squares over rollouts, time and channels. What the
      mixture of the close draws misses is over the median of what it misses of each draw that is left out. The
      distance from the nearest draw of the posterior is over the median of the draws' from theirs: it says how much
      what is missed matters beside the posterior's width.
    """
    rng, replayed = np.random.default_rng(problem.seed), problem.open_loop
    draws = unit[np.unique(resample(rng, normalised(log_weights), DRAWS))]
    found: _Traces = replayed.simulate(draws, view=_traces)
    if found.valid.sum() < LEAST_DRAWS:
        return Departures({}, len(draws))
    ended, wide = draws[found.valid], found.products()
    nearest = best = _mixture(wide[JOINTS].sum(axis=0)) @ ended
    each = tuple(tuple((_mixture(own) @ ended).tolist()) for own in wide[JOINTS])
    told = Departures({}, len(draws), tuple(nearest.tolist()), each)
    for _ in range(ROUNDS if problem.prior is None else 1):  # further looks could leave a prior that is not flat
        best = best.clip(ended.min(axis=0), ended.max(axis=0))
        close = rng.normal(best, CLOSE, (CLOSE_DRAWS * len(best), len(best))).clip(0.0, 1.0)
        near: _Traces = simulate_with(replayed, close, draw_scales(replayed, len(close), rng), _traces)
        told = told._replace(particles=told.particles + len(close))
        if near.valid.sum() < LEAST_DRAWS:
            return told
        ended, narrow = close[near.valid], near.products()
        signals = {name: _departure(narrow[name], wide[name]) for name in narrow}
        before = told.signals[JOINTS].error if told.signals else np.inf
        if signals[JOINTS].error < before:
            told = told._replace(signals=signals)
        if not told.far or signals[JOINTS].error > CLOSER * before:
            return told
        best = _mixture(narrow[JOINTS].sum(axis=0)) @ ended
    return told


def _is_far(signal: str, departure: Departure) -> bool:
    stands_out = departure.missed > DEPARTED[signal] and departure.apart > 1.0
    return stands_out and departure.error > NEGLIGIBLE[signal]


def _traces(problem: Problem, simulated: Simulated) -> _Traces:
    """The view of `Problem.simulate`."""
    pairs = [(seen, group.arrays) for seen, group in zip(simulated.readings, problem.groups, strict=True)]
    tilted = all(real.attitude is not None for _, real in pairs)
    joints = ((seen.joint_position, real.joint_position) for seen, real in pairs)
    tilts = ((seen.roll_pitch, real.roll_pitch) for seen, real in pairs if tilted)
    return _Traces(_differences(joints), _differences(tilts), simulated.valid)


def _differences(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    return tuple((simulated - real).astype(np.float32) for simulated, real in pairs)


def _products(groups: tuple[np.ndarray, ...], valid: np.ndarray) -> np.ndarray:
    """(R, V, V) of (N, S, T, C) differences in each group, for (N,) bool simulations, V of them valid."""
    found, samples = [], 0
    for group in groups:
        for rollout in np.moveaxis(group[valid], 1, 0):
            flat = rollout.reshape(len(rollout), -1).astype(float)
            flat = flat[:, np.isfinite(flat).all(axis=0)]
            found.append(flat @ flat.T)
            samples += flat.shape[1]
    return np.stack(found) / max(samples, 1)


def usual_simulations(dimensions: int) -> int:
    """Particles that `departures` simulates where it need not look again."""
    return DRAWS + CLOSE_DRAWS * dimensions


def _mixture(products: np.ndarray, ridge: float | None = None) -> np.ndarray:
    """(V,) weights of sum 1 with which differences of these (V, V) mean products nearly cancel."""
    held = products + (_ridge(products) if ridge is None else ridge) * np.eye(len(products))
    weights = np.linalg.solve(held, np.ones(len(products)))
    return weights / weights.sum()


def _ridge(products: np.ndarray) -> float:
    """A share of the draws' mean variance; never nothing, so that equal draws weigh alike."""
    return RIDGE * float(np.trace(products) / len(products) - products.mean()) + np.finfo(float).tiny


def _apart(products: np.ndarray) -> float:
    """Of (V, V) mean products of the differences from the robot; 1 where all draws are equal."""
    own = np.diag(products)
    among = own[:, None] + own - 2 * products + np.diag(np.full(len(own), np.inf))
    nearest = float(np.median(np.sqrt(np.maximum(among.min(axis=1), 0.0))))
    return float(np.sqrt(own.min())) / nearest if nearest > 0 else 1.0


def _departure(close: np.ndarray, wide: np.ndarray) -> Departure:
    """Of (R, V, V) products of the differences from the robot, of the close draws and of the posterior's."""
    ridge = _ridge(close.sum(axis=0))

    def missed(products: np.ndarray) -> np.ndarray:
        """(R + 1,) root mean squares that the nearest mixture of draws leaves in each rollout, and in all."""
        weights = _mixture(products.sum(axis=0), ridge)
        left = np.maximum(np.einsum("v,rvw,w->r", weights, products, weights), 0.0)
        return np.sqrt(np.r_[left, left.sum()])

    def without(i: int) -> np.ndarray:
        """Products of the others' differences from draw i."""
        seen = close - close[:, i, None] - close[:, :, i, None] + close[:, i, i, None, None]
        return np.delete(np.delete(seen, i, axis=1), i, axis=2)

    error, others = missed(close), np.median([missed(without(i)) for i in range(close.shape[1])], axis=0)
    *each, whole = np.divide(error, others, out=np.ones_like(error), where=others > 0).tolist()
    return Departure(whole, _apart(wide.sum(axis=0)), float(error[-1]), tuple(each))
