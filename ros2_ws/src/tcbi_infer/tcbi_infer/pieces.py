"""A long recording cut into rollouts that each begin while it moves, at the position and speed measured there.

Motion that a small error throws far off (a swinging pendulum driven by torque) can be predicted for a second, not for
ten; and a part of a long log is often enough for a fit. The pieces of one recording are one kind of motion.
"""

import dataclasses

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer.errors import MappingError
from tcbi_infer.readings import shifted, within
from tcbi_sim.measurement import Commands, Measurement

LEAST = 0.5  # of a window: a shorter rest is left out
SPEED_OVER = 0.03  # s, either side of a piece's begin: what its speed is measured over
COMMAND_DIGITS = 3  # commands of all pieces on one grid of milliseconds are simulated several times as fast
FEWEST = 5  # samples that a speed is measured from


def pieces(m: Measurement, window: float) -> list[Measurement]:
    """Rollouts of `window` s, in order, named after the recording with a number.

    A window with fewer than two samples, in a gap of the recording, is left out, and the others' notes say so.

    Raises:
      MappingError: no window holds two samples.
    """
    cuts: dict[int, np.ndarray] = {}
    count = 0
    if window >= np.diff(m.time).min():
        count = max(1, int((m.scenario.duration + (1 - LEAST) * window) / window))
        for k in map(int, np.unique(m.time // window)):
            inside = (m.time >= k * window) & (m.time <= min((k + 1) * window, m.scenario.duration))
            if k < count and inside.sum() > 1:
                cuts[k + 1] = inside
    if not cuts:
        raise MappingError(f"{m.rollout_id}: no window of {window:g} s holds two samples; make it longer (--window)")
    if len(cuts) < count:
        empty = counted(count - len(cuts), "window")
        m = dataclasses.replace(m, notes=(*m.notes, f"{empty} of {window:g} s with fewer than two samples left out"))
    return [_piece(m, inside, number) for number, inside in cuts.items()]


def _piece(m: Measurement, inside: np.ndarray, number: int) -> Measurement:
    zero = float(m.time[inside][0])
    position, velocity = _state(m, zero)
    scenario = dataclasses.replace(
        m.scenario,
        duration=float(m.time[inside][-1]) - zero,
        initial_joint_position=tuple(map(float, position)),
        initial_joint_velocity=tuple(map(float, velocity)),
    )
    return dataclasses.replace(
        m,
        rollout_id=f"{m.rollout_id}-{number:02d}",
        policy_id=m.policy_id or m.rollout_id,
        scenario=scenario,
        commands=_commands(m.commands, zero, scenario.duration),
        time=np.round(m.time[inside] - zero, 9),
        joint_position=m.joint_position[inside],
        readings=within(shifted(m.readings, -zero), 0.0, scenario.duration),
    )


def _state(m: Measurement, at: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and speed (J,) at a time: a cubic through the samples around it, a parabola where they are few."""
    near = np.abs(m.time - at) <= SPEED_OVER
    if near.sum() < FEWEST:
        near = np.isin(np.arange(len(m.time)), np.argsort(np.abs(m.time - at))[:FEWEST])
    order = min(3, max(1, (int(near.sum()) - 1) // 2))
    fitted = np.polynomial.polynomial.polyfit(m.time[near] - at, m.joint_position[near], order)
    return fitted[0], fitted[1]


def _commands(whole: Commands, zero: float, duration: float) -> Commands:
    """The commands of a piece on its own clock; the one in force when it begins counts from there."""
    before = np.flatnonzero(whole.time <= zero)
    first = int(before[-1]) if before.size else 0
    chosen = slice(first, int(np.searchsorted(whole.time, zero + duration)))
    time = np.round(np.maximum(whole.time[chosen] - zero, 0.0), COMMAND_DIGITS)
    last = np.diff(time, append=np.inf) > 0  # of the commands within a millisecond
    on = None if whole.torque_on is None else whole.torque_on[chosen][last]
    return Commands(time[last], whole.target[chosen][last], whole.ramp, on)
