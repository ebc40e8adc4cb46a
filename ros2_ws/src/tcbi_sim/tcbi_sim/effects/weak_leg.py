"""One leg whose servos give less torque than the others'."""

from tcbi_sim.effect import Effect, Values, each_leg
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    servos = fields.actuators(rig.legs[site])
    fields.scale_gain(servos, values["scale"])
    fields.model["actuator_forcerange"][:, servos] *= values["scale"][:, None, None]


EFFECT = Effect(
    name="weak_leg",
    physics=(
        "A worn or badly supplied leg gives less torque than the others at the same error of its joints, and reaches "
        "less at most. It sags in stance, the trunk leans to its side, and under much load it gives way."
    ),
    source="single-leg fault model as in Cully et al., Robots that can adapt like animals, Nature 521 (2015)",
    parameters=(
        Parameter("scale", "1", 0.2, 1.5, 0.6, null=1.0, scale="log", description="of the other servos' torque"),
    ),
    apply=apply,
    sites=each_leg,
    requires=lambda rig: "" if rig.legs else "it has no legs",
)
