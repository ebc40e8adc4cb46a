"""The tracker's frame: where the robot heads in it, and positions turned to where it was asked to head."""

import math
from collections.abc import Sequence

import numpy as np

from tcbi_sim.measurement import Scenario

TURNED = 0.05  # rad: less is how well a robot can be placed, and costs a thousandth of the way


def heading(orientation: Sequence[float]) -> float | None:
    """Where the robot's x axis points in the horizontal plane, rad; None for what is no unit quaternion x y z w."""
    x, y, z, w = orientation
    if not abs(math.hypot(x, y, z, w) - 1) < 1e-2:
        return None
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wanted_heading(scenario: Scenario) -> float:
    """Where a robot heads that stands on its ground as the scenario asks, rad."""
    roll, pitch, yaw = scenario.slope_roll, scenario.slope_pitch, scenario.initial_yaw
    forward = math.cos(yaw) * math.cos(pitch) + math.sin(yaw) * math.sin(roll) * math.sin(pitch)
    return math.atan2(math.sin(yaw) * math.cos(roll), forward)


def turned(position: np.ndarray, angle: float) -> np.ndarray:
    """(T, 3) positions turned about the vertical through the first of them by an angle in rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    start = position[np.isfinite(position).all(axis=1)][:1]
    result = position.copy()
    result[:, :2] = start[0, :2] + (position - start)[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    return result
