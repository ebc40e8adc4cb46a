"""How the truth about a robot is said in the library's words: which use is right, which parameter has which value."""

import math
from collections.abc import Iterator
from typing import Any

from tcbi_bringup.emulated_robot.hidden_names import OUTSIDE, parts

BASE = ("friction", "mass", "gain")
SITES = ("leg", "joint")  # of the truth, where an effect of the library has a place
SIZES = {  # (the library's parameter, the truth's value that says the same); others have no common number
    "backlash": (("gap", "gap_rad"),),
    "battery_sag": (("drop", "drop_at_stall"),),
    "cable_pull": (("x", "x_n"), ("y", "y_n")),
    "command_deadband": (("angle", "band_rad"),),
    "command_latency": (("delay", "latency_s"),),
    "coulomb_friction": (("torque", "sliding_torque_n_m"),),
    "gain_scatter": (("scale", "stiffness_factor"),),
    "gyro_bias": (("x", "x_rad_s"), ("y", "y_rad_s"), ("z", "z_rad_s")),
    "imu_tilt": (("roll", "roll_rad"), ("pitch", "pitch_rad")),
    "joint_offset": (("angle", "offset_rad"),),
    "link_flexibility": (("compliance", "compliance_rad_per_n_m"),),
    "load_friction": (("share", "lost_share"),),
    "lost_commands": (("share", "lost_share"),),
    "payload": (("mass", "mass_kg"), ("moment_x", "moment_x_kg_m"), ("moment_y", "moment_y_kg_m")),
    "rotor_inertia": (("inertia", "inertia_kg_m2"),),
    "sensor_latency": (("delay", "latency_s"),),
    "slippery_ground": (("grip", "grip"),),
    "slope_error": (("roll", "roll_rad"), ("pitch", "pitch_rad")),
    "soft_ground": (("time_constant", "time_constant_s"),),
    "speed_limit": (("slowness", "slowness_s_per_rad"),),
    "stribeck_friction": (("static", "static_torque_n_m"), ("load_share", "load_share")),
    "thermal_fading": (("loss", "loss_per_s_at_stall"),),
    "torque_saturation": (("share", "remaining_torque_share"),),
    "viscous_damping": (("damping", "damping_n_m_s_per_rad"),),
    "weak_leg": (("scale", "remaining_torque_share"),),
}
Result = dict[str, Any]


def outside(hidden: str) -> bool:
    """Whether the library lacks what is hidden."""
    return any(part in OUTSIDE for part in parts(hidden))


def right_uses(result: Result) -> set[str]:
    """Uses of the library's effects that are in the robot, with their place."""
    return {_use(name, told) for name, told in _effects(result)}


def size_hits(result: Result) -> Iterator[tuple[str, bool, bool]]:
    """Effect, whether the interval of one of its parameters holds the truth, and whether the effect was named.

    Every effect counts that was fitted in its place, by its last fit: where it was named, the one that named it.
    """
    rankings = [result["ranking"], *(later["ranking"] for later in result["rounds"])]
    fitted = {e["use"]: e for ranking in rankings for e in ranking}
    for name, told in _effects(result):
        use = _use(name, told)
        if use not in fitted:
            continue
        values = {p["name"].rpartition(".")[2]: p for p in fitted[use]["parameters"]}
        for parameter, key in SIZES.get(name, ()):
            if parameter in values and key in told:
                holds = values[parameter]["low90"] <= told[key] <= values[parameter]["high90"]
                yield name, holds, use in result["found"]


def base_hits(result: Result) -> list[bool]:
    """Whether each interval of the base model's parameters holds the true value."""
    truth = result["truth"]
    return [p["low90"] <= float(truth[p["name"]]) <= p["high90"] for p in result["base"] if p["name"] in BASE]


def finite(value: float | None) -> float:
    """NaN of none."""
    return math.nan if value is None else float(value)


def _effects(result: Result) -> list[tuple[str, dict[str, Any]]]:
    names, told = parts(result["hidden"]), result["truth"]["effect"]
    return [(name, told if len(names) == 1 else told[name]) for name in names]


def _use(name: str, told: dict[str, Any]) -> str:
    place = next((told[site] for site in SITES if site in told), "")
    return f"{name}:{place}" if place and name not in OUTSIDE else name
