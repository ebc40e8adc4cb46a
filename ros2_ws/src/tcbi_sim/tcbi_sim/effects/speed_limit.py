"""Motors whose torque is used up at speed."""

from tcbi_sim.effect import Effect, Values, lacks, position_servos, torque_limited
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.power import MADE_UP
from tcbi_sim.rig import Rig


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    stall = fields.model["actuator_forcerange"][:, fields.actuators(), 1]
    # the loop makes up for the back-EMF as long as it has voltage left: the two cancel until the torque is limited
    back_emf = values["slowness"][:, None] * stall
    fields.memory[MADE_UP] = back_emf
    fields.powered_damping += back_emf


EFFECT = Effect(
    name="speed_limit",
    physics=(
        "A turning motor makes a voltage against its supply, so the greatest torque falls in a straight line from the "
        "stall torque to nothing at the speed without load. Slow motions and held loads show nothing, fast ones trail "
        "behind once the voltage is used up, lifting more than lowering."
    ),
    source=(
        "Hughes and Drury, Electric Motors and Drives, 5th edition (2019), section 3.4 (torque against speed); MuJoCo: "
        "the velocity terms of actuator/biasprm and joint/damping, which cancel until actuator/forcerange is reached"
    ),
    parameters=(
        Parameter(
            "slowness", "s/rad", 0.0, 0.6, 0.3, null=0.0, description="inverse of the speed at which no torque is left"
        ),
    ),
    apply=apply,
    requires=lambda rig: position_servos(rig) or torque_limited(rig) or lacks("back_emf")(rig),
)
