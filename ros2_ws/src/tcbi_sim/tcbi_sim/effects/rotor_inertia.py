"""The rotor's inertia, seen through the gears."""

from tcbi_sim.effect import Effect, Values, lacks
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.model["dof_armature"][:, fields.dofs()] += values["inertia"][:, None]


EFFECT = Effect(
    name="rotor_inertia",
    physics=(
        "A rotor turns faster than the joint by the gear ratio, so its inertia counts with the ratio's square. Joints"
        " start and stop more slowly and overshoot when damping is low."
    ),
    source="Featherstone, Rigid Body Dynamics Algorithms (2008), section 9.6; MuJoCo: joint/armature",
    parameters=(
        Parameter("inertia", "kg m^2", 0.0, 0.02, 0.003, null=0.0, description="added to each joint's armature"),
    ),
    apply=apply,
    requires=lacks("armature"),
)
