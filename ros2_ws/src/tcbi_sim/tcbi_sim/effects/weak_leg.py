"""One leg whose servos are softer than the others'."""

from tcbi_sim.effect import Effect, Values, each_leg
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.scale_gain(fields.actuators(rig.legs[site]), values["scale"])


EFFECT = Effect(
    name="weak_leg",
    physics=(
        "A worn or badly supplied leg yields more than the others under the same load. Its joints sag in stance and "
        "the trunk leans to its side."
    ),
    source="single-leg fault model as in Cully et al., Robots that can adapt like animals, Nature 521 (2015)",
    parameters=(
        Parameter("scale", "1", 0.2, 1.5, 0.6, null=1.0, scale="log", description="of the other servos' stiffness"),
    ),
    apply=apply,
    sites=each_leg,
    requires=lambda rig: "" if rig.legs else "it has no legs",
)
