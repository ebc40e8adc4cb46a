"""A physical effect: what it is, where it is known from, its parameters, and how it changes a simulation.

An effect is one small file in `effects/` (or in a folder of the user's own, docs/effects.md) that defines `EFFECT`. A
use of an effect in a model is written `name`, or `name:site` for an effect that has a choice of place (a leg, a joint).
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from tcbi_contract.errors import TcbiError
from tcbi_sim.errors import EffectError
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig

Values = dict[str, np.ndarray]
Apply = Callable[[Fields, Rig, str, Values], None]


def everywhere(rig: Rig) -> tuple[str, ...]:
    """An effect without a choice of place."""
    return ("",)


def each_leg(rig: Rig) -> tuple[str, ...]:
    """An effect of one leg."""
    return tuple(rig.legs)


def each_joint(rig: Rig) -> tuple[str, ...]:
    """An effect of one joint."""
    return rig.joint_names


def any_rig(rig: Rig) -> str:
    """No requirement."""
    return ""


def lacks(quantity: str) -> Callable[[Rig], str]:
    """Only for rigs whose own parameters do not set this quantity at every joint already (`Rig.own_quantities`)."""

    def why_not(rig: Rig) -> str:
        return f"its own parameters already set the {quantity}" if quantity in rig.own_quantities else ""

    return why_not


def position_servos(rig: Rig) -> str:
    """Only for rigs whose commands are positions."""
    return "" if rig.kind == "position" else "its commands are torques, not positions"


def torque_limited(rig: Rig) -> str:
    """Only for rigs whose servos have a greatest torque."""
    return "" if rig.has_torque_limit else "not every servo of it has a torque limit"


def floating_rig(rig: Rig) -> str:
    """Only for robots that stand free on the ground."""
    return "" if rig.floating else "it does not stand on the ground"


def rig_with_imu(rig: Rig) -> str:
    """Only for rigs with an IMU."""
    return "" if rig.has_imu else "it has no IMU"


@dataclass(frozen=True)
class Effect:
    """A physical effect that a model may lack."""

    name: str
    physics: str  # a paragraph
    source: str
    parameters: tuple[Parameter, ...]  # each with its null value
    apply: Apply  # writes B simulations' fields; adds to or multiplies what stands there
    edit: Callable[[mujoco.MjSpec, Rig, str], None] | None = None  # structural change, without parameters
    update: Callable[[Fields, Rig, str, Values, "State", float], None] | None = (
        None  # before each sample, for what drifts
    )
    sites: Callable[[Rig], tuple[str, ...]] = everywhere
    requires: Callable[[Rig], str] = any_rig  # "" or why this rig cannot have it
    includes: tuple[str, ...] = ()  # effects that it is where others of its parameters are null: it is a richer law


@dataclass
class State:
    """What an effect that changes with time may look at: the state before a sample interval."""

    time: float  # s
    joint_position: np.ndarray  # (B, J) rad
    joint_velocity: np.ndarray  # (B, J) rad/s
    actuator_force: np.ndarray  # (B, J) N m of the motors, before back-EMF takes its part


@dataclass(frozen=True)
class EffectUse:
    """An effect at a place: `weak_leg:lm`."""

    effect: Effect
    site: str

    @property
    def key(self) -> str:
        """How the use is written."""
        return f"{self.effect.name}:{self.site}" if self.site else self.effect.name

    def apply(self, fields: Fields, rig: Rig, row: Values) -> None:
        """Write the fields for all parameters' values.

        Raises:
          EffectError: the effect's own code fails.
        """
        with self._named("apply"):
            self.effect.apply(fields, rig, self.site, self.values(row))

    def update(self, fields: Fields, rig: Rig, row: Values, state: State, interval: float) -> None:
        """Write what has changed in the last `interval` (s), for an effect that changes with time; as `apply`."""
        with self._named("update"):
            assert self.effect.update is not None
            self.effect.update(fields, rig, self.site, self.values(row), state, interval)

    def edit(self, spec: mujoco.MjSpec, rig: Rig) -> None:
        """Make the structural change, where there is one; raises as `apply`."""
        if self.effect.edit:
            with self._named("edit"):
                self.effect.edit(spec, rig, self.site)

    @contextlib.contextmanager
    def _named(self, part: str) -> Iterator[None]:
        try:
            yield
        except TcbiError:
            raise
        except Exception as e:
            raise EffectError(self.key, part, e, self.effect.apply.__code__.co_filename) from e

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The effect's parameters under their qualified names, `weak_leg:lm.scale`."""
        return tuple(replace(p, name=f"{self.key}.{p.name}") for p in self.effect.parameters)

    def values(self, row: dict[str, np.ndarray]) -> Values:
        """This use's part of all parameters' values, under the effect's own names."""
        return {p.name: row[f"{self.key}.{p.name}"] for p in self.effect.parameters}
