"""Where the hexapod's feet are, and which joint angles put them there; closed form, from the rig's dimensions.

Feet are points (6, 3) in m in the body frame (x forward, y left, z up, origin in the trunk), legs in the contract's
order; joint angles are (18,) or (6, 3) in rad, coxa, femur, tibia.
"""

import math

import numpy as np

from tcbi_contract.names import JOINT_LIMIT, LEGS
from tcbi_sim.rigs.hexapod import dimensions

SIDE = np.array([-1.0 if leg.startswith("l") else 1.0 for leg in LEGS])  # turns a forward swing into a rotation about z


def forward(angles: np.ndarray) -> np.ndarray:
    """Feet (..., 6, 3) in m of joint angles (..., 18) in rad."""
    angles = np.asarray(angles, float)
    coxa, femur, tibia = np.moveaxis(angles.reshape(*angles.shape[:-1], 6, 3), -1, 0)
    leg = dimensions()["leg"]
    upper = leg["femur_elevation"] + femur
    lower = leg["tibia_tilt"] - math.pi / 2 + femur + tibia
    reach = leg["coxa_length"] + leg["femur_length"] * np.cos(upper) + leg["tibia_length"] * np.cos(lower)
    height = leg["femur_length"] * np.sin(upper) + leg["tibia_length"] * np.sin(lower)
    turn = _directions() + SIDE * coxa
    return _hips() + np.stack([reach * np.cos(turn), reach * np.sin(turn), height], axis=-1)


def inverse(feet: np.ndarray) -> np.ndarray:
    """Joint angles (18,) in rad, knees up, that bring the feet (6, 3) nearest within the joint range."""
    leg = dimensions()["leg"]
    offset = np.asarray(feet, float) - _hips()
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - _directions()
    coxa = SIDE * (np.mod(turn + np.pi, 2 * np.pi) - np.pi)
    reach, height = np.hypot(offset[:, 0], offset[:, 1]) - leg["coxa_length"], offset[:, 2]
    upper_length, lower_length = leg["femur_length"], leg["tibia_length"]
    distance = np.clip(np.hypot(reach, height), 1e-6, upper_length + lower_length)
    cosine = (upper_length**2 + distance**2 - lower_length**2) / (2 * upper_length * distance)
    upper = np.arctan2(height, reach) + np.arccos(np.clip(cosine, -1.0, 1.0))
    lower = np.arctan2(height - upper_length * np.sin(upper), reach - upper_length * np.cos(upper))
    femur = upper - leg["femur_elevation"]
    tibia = lower - (leg["tibia_tilt"] - math.pi / 2) - femur
    angles = np.stack([coxa, femur, tibia], axis=-1).reshape(-1)
    return np.clip(angles, -JOINT_LIMIT, JOINT_LIMIT)


def neutral_feet() -> np.ndarray:
    """Feet (6, 3) in m in the neutral stance."""
    return forward(np.zeros(18))


def from_hips() -> np.ndarray:
    """Directions (6, 3), of length 1 and level, in which the legs reach out in the neutral stance."""
    angle = _directions()
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=-1)


def _hips() -> np.ndarray:
    return np.array([dimensions()["hips"][leg]["position"] for leg in LEGS])


def _directions() -> np.ndarray:
    return np.array([dimensions()["hips"][leg]["direction"] for leg in LEGS])
