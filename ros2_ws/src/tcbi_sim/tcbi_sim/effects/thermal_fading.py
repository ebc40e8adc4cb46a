"""Servos that weaken as they warm up."""

import numpy as np

from tcbi_sim.effect import Effect, State, Values, torque_limited
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

MEMORY = "thermal_fading"  # each motor's warmth (B, J), as the torque lost over the torque left


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.strength /= 1 + fields.carried(MEMORY)


def update(fields: Fields, rig: Rig, site: str, values: Values, state: State, interval: float) -> None:
    warmth, load = fields.memory[MEMORY], state.actuator_force / fields.stall_torque
    heating, kept = values["loss"][:, None] * load**2, np.exp(-interval / values["time_constant"][:, None])
    warmer = warmth * kept + heating * values["time_constant"][:, None] * (1 - kept)
    fields.strength *= (1 + warmth) / (1 + warmer)
    fields.memory[MEMORY] = warmer


EFFECT = Effect(
    name="thermal_fading",
    physics=(
        "A winding warms with the square of its current: its resistance grows, the magnets weaken, and firmware cuts "
        "the current of a hot motor. Joints that carry much hang lower from second to second and recover at rest, "
        "those that carry little do not change. Warmth w is counted as torque lost over torque left, "
        "so that a motor keeps 1 / (1 + w) of its torque."
    ),
    source=(
        "Hughes and Drury, Electric Motors and Drives, 5th edition (2019), section 3.7 (heating, time constants); a "
        "rotor of 2 g copper warms by some 5 K in a second at stall, by 0.4 % resistance each"
    ),
    parameters=(
        Parameter(
            "loss",
            "1/s",
            0.0,
            1.0,
            0.3,
            null=0.0,
            description="torque lost over torque left, gained in a second at the stall torque",
        ),
        Parameter("time_constant", "s", 5.0, 300.0, 60.0, scale="log", description="of cooling"),
    ),
    apply=apply,
    update=update,
    requires=torque_limited,
)
