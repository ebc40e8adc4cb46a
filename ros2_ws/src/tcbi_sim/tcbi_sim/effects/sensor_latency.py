"""Readings are stamped late."""

from tcbi_sim.effect import Effect, Values
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.sensing.latency += values["delay"]


EFFECT = Effect(
    name="sensor_latency",
    physics=(
        "A reading is taken before its stamp says so: filters, polling and buffers age it. All sensors show the past,"
        " so a policy acts on it, and recorded signals lag behind commands together."
    ),
    source="Tan et al., Sim-to-real: learning agile locomotion for quadruped robots, RSS 2018, section IV",
    parameters=(Parameter("delay", "s", 0.0, 0.1, 0.03, null=0.0, description="age of a reading at its stamp"),),
    apply=apply,
)
