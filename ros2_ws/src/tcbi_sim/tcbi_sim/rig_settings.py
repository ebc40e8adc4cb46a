"""What a parameter of a described rig may set, and how it is written into B simulations at once."""

import math
from dataclasses import dataclass

import numpy as np

from tcbi_sim.fields import Fields

PLACES = {  # quantity: what it is a quantity of
    "gain": "joints",  # N m/rad, stiffness of the position servo; its lag stays
    "lag": "joints",  # s, by which a position servo trails a moving target: its damping over its stiffness
    "torque_limit": "joints",  # N m
    "damping": "joints",  # N m s/rad
    "friction": "joints",  # N m, Coulomb
    "armature": "joints",  # kg m^2
    "mass": "bodies",  # kg, inertia in proportion
    "inertia": "bodies",  # kg m^2, all three; mostly as a factor
    "sliding_friction": "geoms",  # 1
}
DOF_FIELDS = {"damping": "dof_damping", "friction": "dof_frictionloss", "armature": "dof_armature"}


@dataclass(frozen=True)
class Setting:
    """One quantity at some places.

    Attributes:
      factor: the value multiplies what the model file says, else it replaces it.
      default: of a recording's constant that a recording does not give; NaN leaves the model file's value.
    """

    name: str
    quantity: str  # one of PLACES
    places: tuple[str, ...]
    factor: bool = False
    default: float = math.nan


def write(fields: Fields, setting: Setting, value: np.ndarray) -> None:
    """Write values (B,) into the simulations' fields; NaN leaves the model file's."""
    model, places = fields.model, setting.places
    column = value[:, None]
    if setting.quantity in DOF_FIELDS:
        dofs, array = fields.dofs(places), model[DOF_FIELDS[setting.quantity]]
        array[:, dofs] = _new(array[:, dofs], column, setting)
    elif setting.quantity == "gain":
        scale_servo(fields, fields.actuators(places), _ratio(_gain(fields, places), column, setting))
    elif setting.quantity == "lag":
        actuators = fields.actuators(places)
        old = -model["actuator_biasprm"][:, actuators, 2] / _gain(fields, places)
        model["actuator_biasprm"][:, actuators, 2] = -_gain(fields, places) * _new(old, column, setting)
    elif setting.quantity == "torque_limit":
        actuators, array = fields.actuators(places), model["actuator_forcerange"]
        limit = _new(array[:, actuators, 1], column, setting)
        array[:, actuators] = np.stack([-limit, limit], axis=-1)
    elif setting.quantity == "sliding_friction":
        geoms, array = [fields.geom(g) for g in places], model["geom_friction"]
        array[:, geoms, 0] = _new(array[:, geoms, 0], column, setting)
    else:
        _write_bodies(fields, setting, column)


def scale_servo(fields: Fields, actuators: np.ndarray, ratio: np.ndarray) -> None:
    """Multiply position servos' stiffness, (B, A), and their damping with it, so that their lag stays."""
    fields.scale_gain(actuators, ratio)
    fields.model["actuator_biasprm"][:, actuators, 2] *= ratio


def _write_bodies(fields: Fields, setting: Setting, column: np.ndarray) -> None:
    bodies, inertia = [fields.body(b) for b in setting.places], fields.model["body_inertia"]
    if setting.quantity == "inertia":
        inertia[:, bodies] = _new(inertia[:, bodies], column[..., None], setting)
        return
    mass = fields.model["body_mass"]
    inertia[:, bodies] *= _ratio(mass[:, bodies], column, setting)[..., None]
    mass[:, bodies] = _new(mass[:, bodies], column, setting)


def _gain(fields: Fields, places: tuple[str, ...]) -> np.ndarray:
    return fields.model["actuator_gainprm"][:, fields.actuators(places), 0]


def _new(old: np.ndarray, value: np.ndarray, setting: Setting) -> np.ndarray:
    return np.where(np.isnan(value), old, old * value if setting.factor else value)


def _ratio(old: np.ndarray, value: np.ndarray, setting: Setting) -> np.ndarray:
    return np.broadcast_to(np.where(np.isnan(value), 1.0, value if setting.factor else value / old), old.shape)
