"""A servo mounted off its zero."""

from tcbi_sim.effect import Effect, Values, each_joint, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.command.offset[:, fields.joint(site)] += values["angle"]
    fields.sensing.joint_offset[:, fields.joint(site)] += values["angle"]


EFFECT = Effect(
    name="joint_offset",
    physics=(
        "A horn sits a tooth off, or the zero was set by eye. The servo reads and commands angles that are wrong by a"
        " constant, so its reading looks right while the trunk leans and a foot carries more or less."
    ),
    source="Elatta et al., An overview of robot calibration, Information Technology Journal 3 (2004)",
    parameters=(Parameter("angle", "rad", -0.2, 0.2, 0.05, null=0.0, description="true angle less the reading"),),
    apply=apply,
    sites=each_joint,
    requires=position_servos,
)
