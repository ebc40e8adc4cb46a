"""Checks of the recording itself, made before any error is shown; each finding is a plain sentence.

A recording with the wrong clock or swapped joints fits no model, and a diagnosis of it would name physics for a
mistake of the wiring.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.signals import reference
from tcbi_infer.gaps import unusable
from tcbi_sim.measurement import Measurement

MOVES = np.radians(2.0)  # rad, standard deviation of a command that counts as motion
SWAPPED = 0.7  # correlation of a joint with the command that it is said to follow; less comes about by chance


def guard(measurements: Sequence[Measurement]) -> list[str]:
    """Findings about the recordings and what their reader had to leave out, each told once for several rollouts."""
    findings: dict[str, list[str]] = {}
    for m in measurements:
        for finding in (*m.notes, *check_recording(m)):
            findings.setdefault(finding, []).append(m.rollout_id)
    sentences = []
    for finding, rollouts in findings.items():
        who = f"all {len(rollouts)} rollouts" if len(rollouts) == len(measurements) else ", ".join(rollouts[:3])
        more = (
            f" and {len(rollouts) - 3} more" if len(rollouts) not in (len(measurements),) and len(rollouts) > 3 else ""
        )
        sentences.append(f"{finding} ({who}{more})." if len(measurements) > 1 else f"{finding}.")
    return sentences


def check_recording(m: Measurement) -> list[str]:
    """Findings about one recording, without any model."""
    return [
        *_clock(m),
        *unusable(m, m.time).sentences,
        *_units(m),
        *_echo(m),
        *_wiring(m),
        *_lag(m),
    ]


def _clock(m: Measurement) -> list[str]:
    findings = []
    steps = np.diff(m.time)
    if len(m.time) < 10:
        return ["Fewer than ten samples: nothing can be compared"]
    if np.any(steps <= 0):
        findings.append("Time stamps repeat or go backwards")
    if abs(m.time[0]) > 1.0:
        findings.append("The samples start more than 1 s away from the rollout's begin: another clock, or a cut bag")
    median, mean = float(np.median(steps)), float(np.mean(steps))
    if mean > 1.2 * median:
        findings.append(f"The stream claims {1 / median:.0f} Hz but delivers {1 / mean:.0f} Hz")
    if m.commands.time.size and m.commands.time[0] > m.time[-1]:
        findings.append("All commands come after the last sample: commands and sensors run on different clocks")
    return findings


def _units(m: Measurement) -> list[str]:
    largest = float(np.nanmax(np.abs(m.joint_position)))
    if largest > 30 * np.pi:
        return ["Joint positions reach hundreds of radians: these look like raw encoder counts or degrees"]
    if largest > 4 * np.pi:
        return ["Joint positions exceed two turns: these look like degrees, or an encoder that lost count"]
    return []


def _echo(m: Measurement) -> list[str]:
    if not m.commands.time.size:
        return ["There are no commands in the recording, so nothing can be replayed"]
    asked = reference(m, m.time)
    if np.max(np.std(asked, axis=0)) > MOVES and np.nanquantile(np.abs(asked - m.joint_position), 0.9) < 1e-3:
        return ["Joint positions are identical to the commands: the recording echoes commands, it measures nothing"]
    return []


def _wiring(m: Measurement) -> list[str]:
    """Mirrored joints move against their command; swapped ones follow each other's."""
    if not m.commands.time.size:
        return []
    asked = reference(m, m.time)
    moving = np.nonzero((np.std(asked, axis=0) > MOVES) & (np.std(m.joint_position, axis=0) > MOVES / 2))[0]
    if not len(moving):
        return []
    correlation = _correlation(asked[:, moving], m.joint_position[:, moving])
    names = [m.joint_names[j] for j in moving]
    findings = [
        f"{name} moves against its command: its sign may be mirrored"
        for k, name in enumerate(names)
        if correlation[k, k] < -0.6
    ]
    own = np.diag(correlation)
    findings += [
        f"{names[a]} and {names[b]} follow each other's commands: they may be swapped"
        for a, b in itertools.combinations(range(len(moving)), 2)
        if min(correlation[a, b], correlation[b, a]) > max(SWAPPED, max(own[a], own[b]) + 0.3)
    ]
    return findings


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, n) correlation of each column of `a` with each of `b`."""
    a = (a - a.mean(axis=0)) / a.std(axis=0)
    b = (b - b.mean(axis=0)) / b.std(axis=0)
    return a.T @ b / len(a)


def common_lag(m: Measurement, reach: float = 0.5, step: float = 0.01) -> float:
    """The lag (s) at which all joints together follow their commands best; NaN if the motion does not tell."""
    asked_std = np.std(reference(m, m.time), axis=0)
    moving = asked_std > MOVES
    if not moving.any():
        return float("nan")
    lags = np.arange(-reach, reach + step / 2, step)
    inside = (m.time > m.time[0] + reach) & (m.time < m.time[-1] - reach)
    if inside.sum() < 20:
        return float("nan")
    target = m.joint_position[inside][:, moving]
    errors = []
    for lag in lags:
        asked = reference(m, m.time[inside] - lag)[:, moving]
        difference = target - asked
        errors.append(np.mean((difference - difference.mean(axis=0)) ** 2))
    best, at_zero = int(np.argmin(errors)), errors[len(lags) // 2]
    told = at_zero > 4 * errors[best] + 1e-6  # a steady ramp looks the same at any lag
    return float(lags[best]) if told else float("nan")


def _lag(m: Measurement) -> list[str]:
    if not m.commands.time.size:
        return []
    lag = common_lag(m)
    if lag <= -0.04:
        return [f"The joints lead their commands by {-1000 * lag:.0f} ms: the streams are stamped by different clocks"]
    if lag >= 0.45:
        return ["The joints follow their commands by half a second or more: check the clocks before blaming the servos"]
    return []
