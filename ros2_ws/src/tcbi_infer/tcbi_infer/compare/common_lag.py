"""A lag that all signals share against the prediction: joints and body alike come as late.

Sensors whose clock is late do this, and so does a robot that takes its commands late; one that is slow in some joints,
or by an amount that depends on the motion, does not. The recordings cannot tell the first two apart, so they are named
together, and nothing is taken out. A fit may make up for a lag with slower servos: joints and body then disagree, and
only a model with a latency of its own shows, when it is predicted without it, how late the signals come.
"""

from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.clocks import AGREE, FOLLOWS
from tcbi_infer.compare.signals import ATTITUDE, JOINT, RATE, Layout
from tcbi_sim.model import Model

LATENCIES = ("command_latency", "sensor_latency")  # effects that a late clock looks like
LEAST = 0.03  # s that all signals must come late
REACH, PART, STEP = 0.45, 0.2, 0.005  # s of the lags tried; at most this part of a rollout; their step
EARLY = 0.15  # s of the lags tried the other way
MOST = 2.0 / 3.0  # of the signals that tell must agree
HALVES = 2.0  # by which the right lag must leave less unexplained than none
STILL = 1e-3  # deg, deg/s, standard deviation of a signal that does not move
FEWEST_JOINTS, FEWEST_BODY = 3, 2  # signals that must tell
FEWEST_ROLLOUTS = 2  # that must be late where there are several


def undetectable(layout: Layout) -> str:
    """Why these signals cannot show such a lag, or ""."""
    joints, body = len(layout.where(JOINT)), len(layout.where(ATTITUDE)) + len(layout.where(RATE))
    if joints >= FEWEST_JOINTS and body >= FEWEST_BODY:
        return ""
    return (
        f"A lag that all signals share cannot be told from a latency: it takes {FEWEST_JOINTS} joints and "
        f"{FEWEST_BODY} signals of the body, and here are {joints} and {body}."
    )


def common_lag(
    layout: Layout,
    time: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    rollouts: Sequence[str],
    without: str = "",
) -> list[str]:
    """The finding, if half of the rollouts or more have such a lag; else nothing.

    A rollout counts if enough of its signals tell, whether they agree or not.

    Args:
      layout: the channels.
      time: (T,) s.
      measured: (R, T, C), NaN where missing.
      predicted: (R, T, C).
      rollouts: (R) names.
      without: the effect that was left out of the prediction.
    """
    lags = np.array([_lag(layout, time, *arrays) for arrays in zip(measured, predicted, strict=True)])
    with np.errstate(invalid="ignore"):
        late = lags >= LEAST
    if late.sum() < min(FEWEST_ROLLOUTS, len(lags)) or 2 * late.sum() < np.isfinite(lags).sum():
        return []
    lag = float(np.median(lags[late]))
    who = "" if late.all() or len(lags) == 1 else f" ({_listed([r for r, k in zip(rollouts, late, strict=True) if k])})"
    said = f"{1000 * lag:.0f} ms later than predicted{without and f' without {without}'}{who}"
    return [
        f"All signals, joints and body alike, come {said}: the sensors' clock "
        "is late against that of the commands, or the robot takes its commands late; these recordings cannot tell "
        "which. Stamp commands and sensors by one clock, or measure how far the two are apart, before calling it a "
        "latency."
    ]


def are_latencies(model: Model) -> list[bool]:
    """(P) which parameters of a model belong to a latency."""
    return [p.name.partition(".")[0].partition(":")[0] in LATENCIES for p in model.parameters]


def without_latency(model: Model, parameters: np.ndarray) -> np.ndarray | None:
    """The (P,) parameters of a model as if its latencies were none; None if it has none."""
    of_effect = are_latencies(model)
    if not any(of_effect):
        return None
    return np.where(of_effect, [0.0 if p.null is None else p.null for p in model.parameters], parameters)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _lag(layout: Layout, time: np.ndarray, measured: np.ndarray, predicted: np.ndarray) -> float:
    """By how much (s) all signals of a rollout (T, C) come late; 0 where they do not agree, NaN where too few tell."""
    lags = signal_lags(time, measured, predicted)
    joints, body = (lags[layout.where(*groups)] for groups in ((JOINT,), (ATTITUDE, RATE)))
    joints, body = joints[np.isfinite(joints)], body[np.isfinite(body)]
    if len(joints) < FEWEST_JOINTS or len(body) < FEWEST_BODY:
        return float("nan")
    middle, other = float(np.median(joints)), float(np.median(body))
    agree = [np.mean(np.abs(found - middle) <= AGREE + STEP / 2) >= MOST for found in (joints, body)]
    return middle if all(agree) and abs(middle - other) <= AGREE else 0.0


def signal_lags(time: np.ndarray, measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(C,) s by which each signal (T, C) follows its prediction, at any gain; NaN where its motion does not tell."""
    return np.array([_follows(time, seen, said) for seen, said in zip(measured.T, predicted.T, strict=True)])


def _follows(time: np.ndarray, seen: np.ndarray, said: np.ndarray) -> float:
    """One signal (T,), over its longest stretch without a gap."""
    good = _longest(np.isfinite(seen) & np.isfinite(said))
    time, seen, said = time[good], seen[good], said[good]
    length = float(time[-1] - time[0]) if len(time) else 0.0
    late = min(REACH, PART * length)
    early = min(EARLY, late)
    if late < 2 * LEAST or np.std(seen) < STILL or np.std(said) < STILL:
        return float("nan")
    inner = (time >= time[0] + late) & (time <= time[-1] - early)
    tried = STEP * np.arange(-round(early / STEP), round(late / STEP) + 1)
    missed = _missed(seen[inner], np.interp(time[inner] - tried[:, None], time, said))
    best, at_none = int(np.argmin(missed)), float(missed[round(early / STEP)])
    told = abs(tried[best]) <= AGREE or at_none > HALVES * missed[best]
    return float(tried[best]) if told and missed[best] < FOLLOWS and 0 < best < len(tried) - 1 else float("nan")


def _longest(good: np.ndarray) -> slice:
    """The longest run of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    runs = list(zip(edges[::2], edges[1::2], strict=True))
    return slice(*max(runs, key=lambda run: run[1] - run[0])) if runs else slice(0, 0)


def _missed(seen: np.ndarray, said: np.ndarray) -> np.ndarray:
    """(N,) share of a signal's (T,) variance that each prediction (N, T) does not explain."""
    seen, said = seen - seen.mean(), said - said.mean(axis=1, keepdims=True)
    size = (seen**2).sum() * (said**2).sum(axis=1)
    explained = np.divide((said @ seen) ** 2, size, out=np.zeros(len(said)), where=size > 0)
    return np.asarray(1.0 - explained)
