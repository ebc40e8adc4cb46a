"""Commands reach the servos late."""

from tcbi_sim.effect import Effect, Values, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.command.latency += values["delay"][:, None]


EFFECT = Effect(
    name="command_latency",
    physics=(
        "Radio, bus and firmware hold a command back before the servo begins to move. Every joint starts late by the "
        "same time whatever its load, and stands still meanwhile."
    ),
    source=(
        "Hwangbo et al., Learning agile and dynamic motor skills for legged robots, Science Robotics 4 (2019), on "
        "actuator delays; Tan et al., Sim-to-real: learning agile locomotion for quadruped robots, RSS 2018, section "
        "IV"
    ),
    parameters=(
        Parameter("delay", "s", 0.0, 0.15, 0.04, null=0.0, description="from the command to the servo's first motion"),
    ),
    apply=apply,
    requires=position_servos,
)
