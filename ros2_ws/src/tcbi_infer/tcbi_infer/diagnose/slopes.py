"""Slopes of a prediction, from all simulations near a place.

A fit that takes a step keeps what it knows of the place before: simulations near the new one still tell its slopes,
and only where none lies near, on either side along each axis, are new ones made. Where a foot may stick or slip, many
simulations around a place say more than two along each axis.
"""

from collections.abc import Callable

import numpy as np

NEAR = 0.6  # of the radius: a place so near to a simulation needs none
RIDGE = 0.03  # squared radii by which known slopes count, against those of the simulations
LEAST_WEIGHT = 1e-3
LEAST_FREEDOM = 0.3  # share of the simulations' degrees of freedom

Predict = Callable[[np.ndarray], np.ndarray]


class Slopes:
    """Simulations of one model so far, and the slopes that they tell.

    Args:
      predict: (N, P) unit vectors -> (N, S, T, C).
    """

    def __init__(self, predict: Predict) -> None:
        self._predict = predict
        self._units: list[np.ndarray] = []
        self._predictions: list[np.ndarray] = []
        self._jacobian: np.ndarray | None = None

    def remember(self, units: np.ndarray, predictions: np.ndarray) -> None:
        """Simulations made elsewhere: (N, P) unit vectors and their (N, S, T, C)."""
        self._units.extend(units)
        self._predictions.extend(predictions)

    def at(self, unit: np.ndarray, predicted: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Slopes at (P,) a place with its (S, T, C) prediction, and how far simulations near it depart from them.

        A simulation counts by its distance in multiples of the radius. In a set that diverges here both are 0; a
        simulation that diverges in another set is left out.

        Returns:
          (S, T, C, P) slopes; (S, T, C) root mean square departure from the straight line.
        """
        self._cover(unit, radius)
        moves, weights = self._near(unit, radius)
        near = np.flatnonzero((weights > LEAST_WEIGHT) & moves.any(axis=1))
        change = np.array([self._predictions[i] for i in near]) - predicted
        change[:, ~unbroken(predicted)] = 0.0
        fine = np.isfinite(change).all(axis=(1, 2, 3))
        moves, weights, change = moves[near][fine], weights[near][fine], change[fine]
        if self._jacobian is None:
            self._jacobian = np.zeros((*predicted.shape, len(unit)))
            ridge = 0.0
        else:
            ridge = RIDGE * radius**2
        known = self._jacobian * unbroken(predicted)[:, None, None, None]
        normal = np.einsum("n,np,nq->pq", weights, moves, moves) + ridge * np.eye(len(unit))
        news = change - np.einsum("np,...p->n...", moves, known)
        gain = np.linalg.pinv(normal, hermitian=True) @ (moves * weights[:, None]).T
        self._jacobian = known + np.einsum("pn,n...->...p", gain, news)
        departure = change - np.einsum("np,...p->n...", moves, self._jacobian)
        freedom = max(1.0 - len(unit) / max(len(moves), 1), LEAST_FREEDOM)
        spread = np.einsum("n,n...->...", weights, departure**2) / max(weights.sum() * freedom, np.finfo(float).tiny)
        return self._jacobian, np.sqrt(spread)

    def _near(self, unit: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """(n, P) moves to all simulations, and (n,) what each counts."""
        moves = np.reshape(self._units, (-1, len(unit))) - unit
        return moves, np.exp(-0.5 * (np.abs(moves).max(axis=1, initial=0.0) / radius) ** 2)

    def _cover(self, unit: np.ndarray, radius: float) -> None:
        """Simulate the places both ways along each axis near which nothing has been simulated."""
        places = np.concatenate([both_ways(unit, axis, radius) for axis in np.eye(len(unit))])
        known = np.reshape(self._units, (-1, 1, len(unit)))
        apart = np.abs(known - places).max(axis=-1).min(axis=0, initial=np.inf)
        units = places[apart > NEAR * radius]
        if len(units):
            self.remember(units, self._predict(units))


def both_ways(unit: np.ndarray, axis: np.ndarray, radius: float) -> np.ndarray:
    """(2, P) places one radius along an axis, both ways; near a bound, one and two inwards."""
    step = radius * axis / np.max(np.abs(axis))
    ahead, back = np.clip(unit + step, 0.0, 1.0), np.clip(unit - step, 0.0, 1.0)
    if np.max(np.abs(ahead - unit)) < radius / 2:
        ahead = np.clip(unit - 2 * step, 0.0, 1.0)
    elif np.max(np.abs(back - unit)) < radius / 2:
        back = np.clip(unit + 2 * step, 0.0, 1.0)
    return np.array([ahead, back])


def unbroken(values: np.ndarray) -> np.ndarray:
    """(S,) which sets of (S, T, C) predictions or residuals did not diverge."""
    return np.isfinite(values).all(axis=(1, 2))
