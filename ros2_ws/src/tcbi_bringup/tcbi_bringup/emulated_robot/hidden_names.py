"""Names of what can be hidden in an emulated robot, for command lines: no physics is imported to check a name.

"none", one effect, or several joined by a plus: "coulomb_friction+payload".
"""

import argparse

NONE = "none"
STRENGTHS = ("strong", "weak")

# that a robot's number draws from, where no effect is named
DRAWN = ("coulomb_friction", "viscous_damping", "command_latency", "backlash", "weak_leg", "payload")
LIBRARY = (  # that the library of effects has, too, by the same names
    *DRAWN,
    *("battery_sag", "cable_pull", "command_deadband", "gain_scatter", "gyro_bias", "imu_tilt", "joint_offset"),
    *("link_flexibility", "load_friction", "lost_commands", "rotor_inertia", "sensor_latency", "slippery_ground"),
    *("slope_error", "soft_ground", "speed_limit", "stribeck_friction", "thermal_fading", "torque_saturation"),
)
OUTSIDE = (  # that the library does not have
    *("bent_leg", "cogging", "integrating_servo", "loose_imu", "one_way_friction", "sticky_feet", "swapped_packets"),
    "unequal_legs",
)
NAMES = (*LIBRARY, *OUTSIDE)


def parts(name: str) -> list[str]:
    """The effects in a name; none of "none"."""
    return [] if name == NONE else name.split("+")


def fault(name: str) -> str:
    """What is wrong with a name, or ""."""
    wrong = [part for part in parts(name) if part not in NAMES]
    if wrong:
        return f"unknown hidden effect {wrong[0]!r}; this robot can have {', '.join((*NAMES, NONE))}"
    if len(set(parts(name))) < len(parts(name)):
        return f"{name!r} names an effect twice; name each once"
    return ""


def hidden(text: str) -> str:
    """The type of a command's argument: a known name, or several joined by +; empty is not given."""
    if text and fault(text):
        raise argparse.ArgumentTypeError(fault(text))
    return text
