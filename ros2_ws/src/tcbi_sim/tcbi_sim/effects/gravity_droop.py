"""A servo that gives way under the weight that it carries."""

from tcbi_sim.effect import Effect, Values, each_joint, lacks, position_servos
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig
from tcbi_sim.rig_settings import scale_servo


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    servo = fields.actuators((site,))
    stiffness = fields.model["actuator_gainprm"][:, servo, 0]
    scale_servo(fields, servo, 1 / (1 + stiffness * values["compliance"][:, None]))


EFFECT = Effect(
    name="gravity_droop",
    physics="A servo whose loop is proportional only needs an error to make a torque: under a weight it stops short of "
    "its command, by the torque over its stiffness, and more so the further the arm reaches out. A joint that carries "
    "no weight does not droop, whatever its stiffness. The time by which the servo trails its command stays.",
    source="Siciliano, Sciavicco, Villani and Oriolo, Robotics: Modelling, Planning and Control (2009), chapter 8 on "
    "decentralised control and on PD control with gravity compensation",
    parameters=(
        Parameter(
            "compliance", "rad/(N m)", 0.0, 0.3, 0.08, null=0.0, description="angle given way per torque at the joint"
        ),
    ),
    apply=apply,
    sites=each_joint,
    requires=lambda rig: position_servos(rig) or lacks("gain")(rig),
)
