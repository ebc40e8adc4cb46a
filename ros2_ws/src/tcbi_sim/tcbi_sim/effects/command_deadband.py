"""Servos that ignore small changes of their target."""

from tcbi_sim.effect import Effect, Values, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.command.deadband += values["angle"][:, None]


EFFECT = Effect(
    name="command_deadband",
    physics=(
        "Servo firmware ignores a new target that differs too little from the last one it took. Small dithers vanish "
        "while large moves arrive whole."
    ),
    source="Feetech STS memory table, dead zone registers (26, 27)",
    parameters=(
        Parameter("angle", "rad", 0.0, 0.1, 0.02, null=0.0, description="smallest change of a target that is taken"),
    ),
    apply=apply,
    requires=position_servos,
)
