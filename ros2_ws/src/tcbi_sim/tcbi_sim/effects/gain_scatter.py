"""One servo that is softer or stiffer than its siblings."""

from tcbi_sim.effect import Effect, Values, each_joint, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.scale_gain(fields.actuators((site,)), values["scale"])


EFFECT = Effect(
    name="gain_scatter",
    physics=(
        "Servos of one batch differ by a few per cent in stiffness, which is normal; one that differs by much more is"
        " worn, of another batch, or set up differently. Its joint sags more or less than the others under the same "
        "load."
    ),
    source=(
        "Hwangbo et al., Learning agile and dynamic motor skills for legged robots, Science Robotics 4 (2019), on "
        "differences between actuators of one make"
    ),
    parameters=(
        Parameter("scale", "1", 0.4, 2.0, 0.8, null=1.0, scale="log", description="of the other servos' stiffness"),
    ),
    apply=apply,
    sites=each_joint,
    requires=lambda rig: position_servos(rig) or ("" if len(rig.joint_names) > 1 else "it has one servo only"),
)
