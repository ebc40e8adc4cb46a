"""Friction that falls with speed and grows with the load through the gears."""

import numpy as np

from tcbi_sim.effect import Effect, State, Values
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

MEMORY = "stribeck_friction"  # what this effect has added to each joint's friction, (B, J) N m


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    dofs = fields.dofs()
    fields.model["dof_frictionloss"][:, dofs] += values["static"][:, None]
    fields.memory[MEMORY] = np.repeat(values["static"][:, None], len(dofs), axis=1)


def update(fields: Fields, rig: Rig, site: str, values: Values, state: State, interval: float) -> None:
    drop = np.exp(-np.square(state.joint_velocity / values["speed"][:, None]))
    torque = values["static"][:, None] * drop + values["load_share"][:, None] * np.abs(state.actuator_force)
    fields.model["dof_frictionloss"][:, fields.dofs()] += torque - fields.memory[MEMORY]
    fields.memory[MEMORY] = torque


EFFECT = Effect(
    name="stribeck_friction",
    physics="Gears that carry a load press on each other and rub in proportion to it, and a film of grease builds up "
    "with speed: friction is highest at rest and under load. Joints that hold a weight stick, the same joints unloaded "
    "hardly do. The load counted is the torque that the motor's voltage would make at rest, before back-EMF takes its "
    "part: at speed the gears carry less of it while the motor drives, and more while it brakes.",
    source="Armstrong-Helouvry, Dupont and Canudas de Wit, A survey of models, analysis tools and compensation methods "
    "for the control of machines with friction, Automatica 30 (1994); load dependence as in Duclusaud et al., Extended "
    "friction models for the physics simulation of servo actuators, arXiv 2410.08650",
    parameters=(
        Parameter("load_share", "1", 0.0, 0.6, 0.15, null=0.0, description="friction torque per torque of the motor"),
        Parameter("static", "N m", 0.0, 0.1, 0.02, null=0.0, description="friction at rest above that at speed"),
        Parameter(
            "speed", "rad/s", 0.03, 3.0, 0.3, scale="log", description="at which the part at rest has faded to 1/e"
        ),
    ),
    apply=apply,
    update=update,
    includes=("load_friction",),
)
