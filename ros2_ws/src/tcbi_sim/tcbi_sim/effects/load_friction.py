"""Friction in proportion to the load that the gears carry."""

import numpy as np

from tcbi_sim.effect import Effect, State, Values
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

MEMORY = "load_friction"  # what this effect has added to each joint's friction, (B, J) N m


def apply(fields: Fields, rig: Rig, site: str, values: Values) -> None:
    fields.memory[MEMORY] = np.zeros((fields.count, len(fields.dofs())))


def update(fields: Fields, rig: Rig, site: str, values: Values, state: State, interval: float) -> None:
    torque = values["share"][:, None] * np.abs(state.actuator_force)
    fields.model["dof_frictionloss"][:, fields.dofs()] += torque - fields.memory[MEMORY]
    fields.memory[MEMORY] = torque


EFFECT = Effect(
    name="load_friction",
    physics="Teeth that carry a load press on each other and rub in proportion to it. A gear with a high ratio loses a "
    "good part of the motor's torque when it lifts, and the same part holds the weight when it lowers: a loaded joint "
    "stops short, stays where it is and lets go late, an unloaded one moves freely. The load counted is the torque "
    "that the motor's voltage would make at rest, before back-EMF takes its part: at speed the gears carry less of it "
    "while the motor drives, and more while it brakes.",
    source="Duclusaud et al., Extended friction models for the physics simulation of servo actuators, arXiv 2410.08650 "
    "(2024), section on load-dependent friction",
    parameters=(
        Parameter("share", "1", 0.0, 0.8, 0.3, null=0.0, description="friction torque per torque of the motor"),
    ),
    apply=apply,
    update=update,
)
