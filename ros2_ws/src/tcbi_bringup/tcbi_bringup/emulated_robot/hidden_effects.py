"""What a robot may have that nobody told the model: a physical effect, or several, in two strengths.

Each is built from the mechanism itself: bristles that bend before they slip, a motor with its own inertia behind a gap,
a bus whose packets wait, a supply line that droops. To add one, write a class in `hidden/` that overrides the hooks of
`HiddenEffect` which its mechanism touches, name it in `hidden_names.py` and enter it in `EFFECTS`.
"""

from collections.abc import Mapping

import numpy as np

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.hidden import bus, friction, gears, ground, outside, power, sensing
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect, Several
from tcbi_bringup.emulated_robot.hidden_names import DRAWN, NONE, STRENGTHS, fault, parts

EFFECTS: Mapping[str, type[HiddenEffect]] = {
    "coulomb_friction": friction.SlippingTeeth,
    "viscous_damping": friction.OilDamping,
    "command_latency": bus.BusDelay,
    "backlash": gears.LooseHorns,
    "weak_leg": power.TiredLeg,
    "payload": ground.Backpack,
    "battery_sag": power.OldBattery,
    "cable_pull": ground.TautCable,
    "command_deadband": bus.DullServos,
    "gain_scatter": gears.OddServo,
    "gyro_bias": sensing.BiasedGyro,
    "imu_tilt": sensing.AskewBoard,
    "joint_offset": gears.SlippedHorn,
    "link_flexibility": gears.SpringyLinks,
    "load_friction": friction.LossyGears,
    "lost_commands": bus.LossyRadio,
    "rotor_inertia": gears.HeavyRotors,
    "sensor_latency": sensing.StaleReadings,
    "slippery_ground": ground.OilyFloor,
    "slope_error": ground.MisreadSlope,
    "soft_ground": ground.Foam,
    "speed_limit": power.BackEmf,
    "stribeck_friction": friction.StickingGears,
    "thermal_fading": power.HotWindings,
    "torque_saturation": power.CurrentLimit,
    "bent_leg": outside.BentLeg,
    "cogging": outside.Cogging,
    "integrating_servo": outside.IntegratingServo,
    "loose_imu": outside.LooseImu,
    "one_way_friction": outside.OneWayFriction,
    "sticky_feet": outside.StickyFeet,
    "swapped_packets": outside.SwappedPackets,
    "unequal_legs": outside.UnequalLegs,
}


class Nothing(HiddenEffect):
    """Nothing hidden: the model has all the physics of this robot, if not its numbers."""

    strong = weak = 0.0


def choose(name: str | None, strength: str | None, seed: int) -> tuple[str, str, HiddenEffect]:
    """The hidden effect of robot number `seed`: what was named, or drawn from the seed where it was not.

    Args:
      name: of an effect, several joined by + (one after another in the order given), "none", or None.
      strength: of all of them; strong where it is None.
      seed: of the robot.

    Raises:
      EmulatedRobotError: an unknown effect or strength, or one effect twice.
    """
    if name is not None and (wrong := fault(name)):
        raise EmulatedRobotError(wrong)
    if strength is not None and strength not in STRENGTHS:
        raise EmulatedRobotError(f"unknown strength {strength!r}; allowed is {' or '.join(STRENGTHS)}")
    rng = np.random.default_rng([seed, 2])
    drawn = str(rng.choice(DRAWN))
    name, strength = name or drawn, strength or STRENGTHS[0]
    if name == NONE:
        return name, strength, Nothing(strength, rng)
    effects = [(part, EFFECTS[part](strength, rng)) for part in parts(name)]
    return name, strength, effects[0][1] if len(effects) == 1 else Several(strength, rng, effects)
