"""Viscous friction in every joint."""

from tcbi_sim.effect import Effect, Values, lacks
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.model["dof_damping"][:, fields.dofs()] += values["damping"][:, None]


EFFECT = Effect(
    name="viscous_damping",
    physics=(
        "Grease and back-EMF resist motion with a torque proportional to speed, beyond what the model already has. "
        "Joints trail behind a moving target by a time that does not depend on the load, and reach it when it stops."
    ),
    source=(
        "Olsson et al., Friction models and friction compensation, European Journal of Control 4 (1998), section 2.1;"
        " MuJoCo: joint/damping"
    ),
    parameters=(
        Parameter("damping", "N m s/rad", 0.0, 0.4, 0.08, null=0.0, description="added to each joint's damping"),
    ),
    apply=apply,
    requires=lacks("damping"),
)
