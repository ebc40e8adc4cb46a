"""Single readings of a joint that were broken on their way: far off those before and after, which agree."""

import dataclasses

import numpy as np

from tcbi_contract.wording import counted
from tcbi_sim.measurement import Measurement

SPIKE = 0.3  # rad off both neighbours, at least
FASTEST = 20.0  # rad/s, at which a joint that is really there would have gone to and fro
RARE = 0.02  # share of a joint's readings; if more are far off, it is the unit or the stream that is wrong


def without_spikes(m: Measurement) -> Measurement:
    """The same with broken readings left out, and with a note of each joint that had some.

    The mean of the readings beside it stands in for a broken one, and counts as not measured (`gaps`).
    """
    broken = broken_readings(m)
    if not broken.any():
        return m
    q, gaps, notes = m.joint_position.copy(), list(m.gaps), list(m.notes)
    for j in np.flatnonzero(broken.any(axis=0)):
        at = np.flatnonzero(broken[:, j])
        q[at, j] = (q[at - 1, j] + q[at + 1, j]) / 2
        jump = float(np.abs(m.joint_position[at, j] - q[at, j]).max())
        notes.append(
            f"{counted(len(at), 'reading')} of {m.joint_names[j]}, the first at {m.time[at[0]]:.2f} s, stand"
            f"{'s' * (len(at) == 1)} up to {jump:.3g} rad off the readings before and after: broken on their way, and "
            "left out"
        )
        gaps += [("joint_position", float(m.time[k - 1]), float(m.time[k + 1])) for k in at.tolist()]
    return dataclasses.replace(m, joint_position=q, gaps=tuple(gaps), notes=tuple(notes))


def broken_readings(m: Measurement) -> np.ndarray:
    """(T, J) bool."""
    q = m.joint_position
    broken = np.zeros(q.shape, bool)
    if len(q) < 3:
        return broken
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(q[1:-1] - (q[:-2] + q[2:]) / 2)
        far = np.maximum(SPIKE, FASTEST * (m.time[2:] - m.time[:-2]) / 2)[:, None]
        broken[1:-1] = (off > far) & (np.abs(q[2:] - q[:-2]) < off / 2)
    return broken & (broken.mean(axis=0) < RARE)
