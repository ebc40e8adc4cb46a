"""A supply whose voltage drops under load."""

import numpy as np

from tcbi_sim.effect import Effect, State, Values, torque_limited
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

MEMORY = "battery_sag"  # the load that the supply has felt, (B, J) with equal columns: 1 where every servo stalls


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.strength *= 1 - values["drop"][:, None] * fields.carried(MEMORY)


def update(fields: Fields, rig: Rig, site: str, values: Values, state: State, interval: float) -> None:
    felt, drop = fields.memory[MEMORY], values["drop"][:, None]
    load = np.abs(state.actuator_force).sum(axis=1) / fields.stall_torque.sum(axis=1)
    kept = np.exp(-interval / values["time_constant"][:, None])
    now = felt * kept + np.minimum(load, 1.0)[:, None] * (1 - kept)
    fields.strength *= (1 - drop * now) / (1 - drop * felt)
    fields.memory[MEMORY] = now


EFFECT = Effect(
    name="battery_sag",
    physics=(
        "All servos share a battery and its leads, whose resistance takes voltage in proportion to the current they "
        "draw together. While many joints lift or the robot stands on few legs, every servo is softer and weaker at "
        "once, also those that carry nothing. Stalled servos draw less as the voltage "
        "falls: where all stall, each keeps 1 / (1 + drop) of its torque."
    ),
    source=(
        "Plett, Battery Management Systems, volume 1 (2015), chapter 2 (equivalent circuit: resistance and one RC pair)"
    ),
    parameters=(
        Parameter(
            "drop", "1", 0.0, 0.9, 0.5, null=0.0, description="torque lost over torque left where every servo stalls"
        ),
        Parameter("time_constant", "s", 0.05, 5.0, 0.3, scale="log", description="in which the voltage follows"),
    ),
    apply=apply,
    update=update,
    requires=torque_limited,
)
