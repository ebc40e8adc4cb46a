"""Commands that never arrive."""

from tcbi_sim.effect import Effect, Values, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.command.loss[:] = 1 - (1 - fields.command.loss) * (1 - values["share"])


EFFECT = Effect(
    name="lost_commands",
    physics=(
        "A radio link drops packets. All joints miss the same command and stay where they were for a control period. "
        "No diagnosis simulates it, since a replay loses other commands; where repeats were recorded it is suspected."
    ),
    source="Gilbert-Elliott channel without memory; Tan et al., RSS 2018, section IV, on dropped packets",
    parameters=(Parameter("share", "1", 0.0, 0.5, 0.1, null=0.0, description="of the commands that are lost"),),
    apply=apply,
    requires=position_servos,
)
