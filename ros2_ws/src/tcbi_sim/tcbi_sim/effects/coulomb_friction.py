"""Dry friction in every joint."""

from tcbi_sim.effect import Effect, Values, lacks
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.model["dof_frictionloss"][:, fields.dofs()] += values["torque"][:, None]


EFFECT = Effect(
    name="coulomb_friction",
    physics=(
        "Gears and bushings resist motion with a torque that does not depend on speed. Small errors of the position "
        "loop stay below it and are never corrected, so joints stop short of their target and stick at reversals."
    ),
    source=(
        "Olsson et al., Friction models and friction compensation, European Journal of Control 4 (1998), section 2.1;"
        " MuJoCo: joint/frictionloss"
    ),
    parameters=(Parameter("torque", "N m", 0.0, 0.15, 0.03, null=0.0, description="friction torque of each joint"),),
    apply=apply,
    requires=lacks("friction"),
)
