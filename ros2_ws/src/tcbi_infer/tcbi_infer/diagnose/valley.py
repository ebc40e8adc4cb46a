"""The line along which data hardly tell a model's parameters, which steps of a fit only creep along.

A heavier robot with stronger servos and more grease moves as a light one does: equations of motion are linear in
masses, stiffnesses and friction torques, so such a valley of the loss is straight in physical units, whatever the
scales of the parameters' ranges. Its walls are steep and its floor is rough and nearly level: slopes say little there,
and far points much.
"""

import numpy as np

from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

REACH = (-0.4, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.4)  # of a range, of the parameter that moves farthest
LEAST = 0.01  # of a range: nearer points are no news
INSIDE = 0.98  # of the way to a bound
NUDGE = 1e-4  # of a range, for the rate of a physical value


def weakest(normal: np.ndarray, count: int) -> np.ndarray:
    """(P,) the direction in unit space that data tell worst, nuisances with unit prior integrated out.

    Args:
      normal: (K, K) curvature of the loss by `count` parameters and the nuisances after them.
      count: P.
    """
    own, cross = normal[:count, :count], normal[:count, count:]
    others = normal[count:, count:] + np.eye(len(normal) - count)
    return np.linalg.eigh(own - cross @ np.linalg.solve(others, cross.T))[1][:, 0]


def points_along(model: Model, unit: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(n, P) unit vectors on both sides of a place, on a line that is straight in physical units and ends at a bound.

    Args:
      model: whose parameters these are.
      unit: (P,) the place.
      direction: (P,) of the line, there, in unit space.
    """
    ahead, back = np.clip(unit + NUDGE, 0.0, 1.0), np.clip(unit - NUDGE, 0.0, 1.0)
    physical = model.from_unit(np.array([back, unit, ahead]))
    pace = (physical[2] - physical[0]) / (ahead - back) * direction / np.max(np.abs(direction))
    low, high = (np.array([getattr(p, side) for p in model.parameters]) for side in ("low", "high"))
    moving = pace != 0
    ends = np.sort([((bound - physical[1])[moving] / pace[moving]) for bound in (low, high)], axis=0)
    first, last = INSIDE * ends[0].max(), INSIDE * ends[1].min()
    reach = np.unique(np.clip(REACH, first, last))
    values = np.clip(physical[1] + reach[np.abs(reach) > LEAST, None] * pace, low, high)
    return model.to_unit(values)


def scaled_together(model: Model, unit: np.ndarray, factor: float) -> np.ndarray:
    """(P,) unit vector with every force, mass and stiffness multiplied alike, which hardly changes a motion.

    Only what the model takes as known (a rotor, a torque limit) tells the common factor, so it is the direction in
    which fits creep.
    """
    result = unit.copy()
    for i, p in enumerate(model.parameters):
        if _is_force(p):
            result[i] = p.to_unit(np.clip(float(p.from_unit(unit[i])) * factor, p.low, p.high))
    return result


def scaled_freely(model: Model, factor: float, unit: np.ndarray) -> np.ndarray | None:
    """The same; None where it has nothing to scale, or a bound is in its way."""
    scaled = scaled_together(model, unit, factor)
    before, after = model.from_unit(np.array([unit, scaled]))
    forces = np.array([_is_force(p) for p in model.parameters]) & (before > 0)
    return scaled if forces.any() and np.allclose(after[forces], factor * before[forces], rtol=1e-3) else None


def shifted_freely(parameter: int, shift: float, unit: np.ndarray) -> np.ndarray | None:
    """(P,) unit vector with one parameter shifted; None out of its range."""
    moved = unit.copy()
    moved[parameter] += shift
    return moved if 0.0 <= moved[parameter] <= 1.0 else None


def is_mass(parameter: Parameter) -> bool:
    """Whether it is one."""
    return parameter.unit == "kg"


def at_level(unit: np.ndarray, parameter: int, level: float) -> np.ndarray:
    """(P,) unit vector with one parameter elsewhere in its range."""
    moved = unit.copy()
    moved[parameter] = np.clip(level, 0.02, 0.98)
    return moved


def _is_force(parameter: Parameter) -> bool:
    """Whether it is a force, a mass or a stiffness."""
    return parameter.low >= 0 and parameter.unit.startswith(("kg", "N"))
