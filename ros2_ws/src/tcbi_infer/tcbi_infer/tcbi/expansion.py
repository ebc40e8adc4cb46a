"""Simulated motions as a polynomial of the parameters, by regression on the simulations so far.

A motion bends far less with the parameters than its distance from the robot's does. So a polynomial through whole
motions says where that distance is least from far fewer simulations than one through distances would, as a Gauss-Newton
step does, with curvature. And it leaves out what contacts throw at random into each single simulation, which says
nothing of its parameters (a synthetic likelihood, Wood 2010, whose mean is regressed on the parameters).

With a flat prior motions bend least over the cube in which it is uniform, with a normal one over probit space. Which it
is, and of which order, the motions decide that are left out one by one.
"""

import itertools
from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.proposal import from_probit

SHARE = 0.5  # of the particles, those of least energy, that are regressed
FEWEST, MOST = 20, 200  # of them
PER_TERM = 2  # particles, at least, for each term of the polynomial
FORESEEN = 4.0  # times what it misses on average, at most, for a motion to count as foreseen
RIDGE = 1e-6  # of the terms' mean square


class Expansion(NamedTuple):
    """Motions expected; an energy is the sum of their squares."""

    cube: bool  # whether over the cube where the prior is uniform, or else over probit space
    center: np.ndarray  # (P,)
    scale: np.ndarray  # (P,)
    order: int  # 1 or 2
    coefficients: np.ndarray  # (F, D) of the motions
    missed: np.ndarray  # (D,) mean squares by which it misses a motion that is left out
    particles: int  # that were regressed

    def energy(self, z: np.ndarray) -> np.ndarray:
        """(N,) expected at (N, P) in probit space."""
        terms = self._terms(z)
        return np.einsum("nf,fg,ng->n", terms, self.coefficients @ self.coefficients.T, terms)

    def motion(self, z: np.ndarray) -> np.ndarray:
        """(N, D) expected at (N, P) in probit space."""
        return self._terms(z) @ self.coefficients

    def foresees(self, expected: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """(N,) whether (N, D) motions are about as expected."""
        return ((motion - expected) ** 2).sum(axis=1) <= FORESEEN * self.missed.sum()

    def _terms(self, z: np.ndarray) -> np.ndarray:
        return _terms(((from_probit(z) if self.cube else z) - self.center) / self.scale, self.order)


def nearest(energy: np.ndarray, dimensions: int) -> np.ndarray | None:
    """Indices of the particles to regress, by (M,) energies that are inf where one diverged; None while too few."""
    usable, fewest = np.flatnonzero(np.isfinite(energy)), PER_TERM * (dimensions + 1)
    if len(usable) < fewest:
        return None
    count = min(max(fewest, FEWEST, int(SHARE * len(usable))), MOST)
    return usable[np.argsort(energy[usable], kind="stable")[:count]]


def expansion(z: np.ndarray, motion: np.ndarray) -> Expansion:
    """Regress the motions of the nearest particles.

    Args:
      z: (N, P) particles in probit space, at least `PER_TERM` for each of P + 1 terms.
      motion: (N, D) what they differ from the robot by; the sum of a row's squares is its part of the energy.
    """
    found = []
    for cube, order in itertools.product((True, False), (1, 2)):
        x = from_probit(z) if cube else z
        center, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
        fit = _fit((x - center) / scale, motion.astype(float), order)
        if fit:
            found.append(Expansion(cube, center, scale, order, *fit, len(z)))
    return min(found, key=lambda e: float(e.missed.sum()))


def _fit(x: np.ndarray, y: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The terms' motions (F, D) and what is missed (D,); None with too few particles."""
    terms = _terms(x, order)
    n, f = terms.shape
    if n < PER_TERM * f:
        return None
    far = (y**2).sum(axis=1)
    weight = 1.0 / (far + np.sort(far)[f - 1])  # what the terms leave out grows with the square of the distance
    weight = weight / weight.max()
    left = terms * weight[:, None]
    inverse = np.linalg.inv(left.T @ left + RIDGE * np.trace(left.T @ left) / f * np.eye(f))
    solve = inverse @ left.T
    found = solve @ (y * weight[:, None])
    leverage = np.minimum(np.einsum("nf,fn->n", left, solve), 0.99)
    close = np.argsort(far, kind="stable")[:f]
    missed = (y[close] - terms[close] @ found) / (1 - leverage[close])[:, None]
    return found, (missed**2).mean(axis=0)


def _terms(x: np.ndarray, order: int) -> np.ndarray:
    """(N, P) -> (N, F): 1, each parameter, and for order 2 their products."""
    ones = np.ones((len(x), 1))
    if order == 1:
        return np.concatenate([ones, x], axis=1)
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([ones, x, x[:, first] * x[:, second]], axis=1)
