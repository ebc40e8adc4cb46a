"""What shorter time steps do to motions, measured on a few particles and allowed for in all.

Steps of 5 ms are quick, and feet land and slip a little otherwise with them: the same in all particles that move much
alike, which no number of rollouts averages, and which friction and mass make up for. So the nearest particles are
simulated once more with steps of 2 ms. By what they move on average every simulation is moved: beyond what is expected
of their motion with long steps, which has no contact's chance in it, or beyond that motion itself, where that scatters
less. How much they differ in that is doubt about all of them.
"""

from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.expansion import Expansion
from tcbi_infer.tcbi.in_time import SKETCH, Differences, InTime, raised

PARTICLES = 6  # that are simulated with short steps
LEAST = 2  # of them, that can be used


class Correction(NamedTuple):
    """From long steps to short ones, in U units and of K statistics that are compared in time."""

    sketch: np.ndarray  # (U, K, SKETCH) float32 by which the sketches of differences move
    doubt: np.ndarray  # (K,) divergence as large as its own error
    particles: int  # that it rests on, 0 while there is none


NONE = Correction(np.zeros((1, 1, SKETCH), np.float32), np.zeros(1), 0)


def correction(
    observed: InTime, floor: np.ndarray, expansion: Expansion, z: np.ndarray, long: Differences, short: Differences
) -> Correction:
    """From particles that were simulated with both.

    Args:
      observed: the real rollouts.
      floor: (K,) that motions are divided by.
      expansion: of the motions with long steps.
      z: (n, P) the particles, at least two.
      long: theirs with long steps.
      short: with short ones.
    """
    motion = observed.motion(short, floor)
    moved = min((motion - expansion.motion(z), motion - observed.motion(long, floor)), key=_scatter)
    sketches = moved.reshape(short.sketch.shape) * np.sqrt(observed.scale(floor))[:, None]
    scatter = sketches.var(axis=0, ddof=1).sum(axis=(0, 2)) / len(z)
    return Correction(sketches.mean(axis=0).astype(np.float32), scatter / observed.scale(np.ones_like(floor)), len(z))


def corrected(found: Differences, by: Correction) -> Differences:
    """Simulations with long steps, as with short ones; squares change as those of the sketches do."""
    more = 2 * np.einsum("muks,uks->muk", found.sketch, by.sketch, dtype=float)
    more += (by.sketch.astype(float) ** 2).sum(axis=-1)
    return Differences(raised(found.sums, more), found.sketch + by.sketch)


def _scatter(moved: np.ndarray) -> float:
    return float(moved.var(axis=0).sum())
