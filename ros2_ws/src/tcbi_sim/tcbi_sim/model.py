"""A model version: a rig, the effects switched on, and a distribution of all their parameters."""

import dataclasses
import datetime
import zlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.wording import counted, with_unit
from tcbi_sim.effect import EffectUse
from tcbi_sim.effects import find_use
from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import load_rig

PRIOR_PARTICLES = 200
JOINT_GAINS = (0.4, 2.0)  # that joints may have


class Fit(NamedTuple):
    """What the particles of a version come from."""

    rollouts: list[str]  # that they have seen, sorted; what their prior had seen is among them
    by: str  # a method of inference, or a kind of evidence; empty where nothing was fitted
    fits: bool | None  # False where the fit said that the model is wrong, None where it could not tell


@dataclass(frozen=True)
class Model:
    """One version of a model of a rig."""

    version: str
    rig: str
    effects: tuple[str, ...]  # uses: "name" or "name:site"
    parameters: tuple[Parameter, ...]  # the rig's own, then each effect's, with qualified names
    particles: np.ndarray  # (N, P) physical values
    log_weights: np.ndarray  # (N,) normalised
    parent: str | None = None
    evidence: dict[str, Any] = field(default_factory=dict)  # what made this version: a diagnosis, an inference
    created: str = ""
    joint_gains: tuple[float, ...] = ()  # (J,) each servo's stiffness over what the parameters say
    fixed: dict[str, float] = field(default_factory=dict)  # what was measured otherwise: no parameters any more

    def __post_init__(self) -> None:
        expected = (*self.log_weights.shape, len(self.parameters))
        if self.particles.shape != expected:
            raise SimError(f"model {self.version!r}: particles have shape {self.particles.shape}, expected {expected}")
        if not np.all(finite := np.isfinite(self.log_weights)):
            raise SimError(
                f"model {self.version!r}: a log-weight is {self.log_weights[~finite][0]}, allowed is a finite number"
            )
        for column, p in zip(self.particles.T, self.parameters, strict=True):
            slack = 1e-9 * (p.high - p.low)
            if not np.all((column >= p.low - slack) & (column <= p.high + slack)):
                seen = column[(column < p.low) | (column > p.high) | np.isnan(column)][0]
                raise SimError(
                    f"model {self.version!r}: parameter {p.name!r} is {seen}, allowed is {p.low} to {p.high} {p.unit}"
                )
        if self.joint_gains:
            self._check_joint_gains()
        if self.fixed:
            self._check_fixed()

    def _check_fixed(self) -> None:
        known = {p.name: p for p in parameters_of(self.rig, self.effects)}
        for name, value in self.fixed.items():
            if name not in known:
                raise SimError(f"model {self.version!r}: fixed {name!r} is none of {', '.join(known)}")
            p = known[name]
            if not p.low <= value <= p.high:
                told = f"fixed {name} is {value:g}, allowed is {p.low:g} to {p.high:g} {p.unit}"
                raise SimError(f"model {self.version!r}: {told}")
        if not self.parameters:
            raise SimError(f"model {self.version!r}: every parameter is fixed, allowed are all but one")

    def _check_joint_gains(self) -> None:
        rig, (low, high) = load_rig(self.rig), JOINT_GAINS
        wrong = [f"{gain}" for gain in self.joint_gains if not low <= gain <= high]
        if rig.kind != "position" or len(self.joint_gains) != len(rig.joint_names) or wrong:
            seen = counted(len(self.joint_gains), "value") + (f", among them {wrong[0]}" if wrong else "")
            allowed = f"{len(rig.joint_names)} of {low} to {high}" if rig.kind == "position" else "none for this rig"
            raise SimError(f"model {self.version!r}: joint_gains has {seen}, allowed is {allowed}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, the columns of `particles`."""
        return tuple(p.name for p in self.parameters)

    @property
    def saved_version(self) -> str:
        """The version that this model is, or that an unsaved one comes from."""
        return self.version.partition("+")[0]

    @property
    def weights(self) -> np.ndarray:
        """(N,), sum to one."""
        w = np.exp(self.log_weights - self.log_weights.max())
        return w / w.sum()

    @property
    def contents(self) -> bytes:
        """All that models of one name and structure may differ in, for digests."""
        known = repr(sorted(self.fixed.items())).encode() if self.fixed else b""
        return self.particles.tobytes() + self.log_weights.tobytes() + np.array(self.joint_gains).tobytes() + known

    @property
    def joint_gains_told(self) -> str:
        """The joints' own gains in words, the softest and the stiffest by name; without any all are alike."""
        if not self.joint_gains:
            return "alike"
        joints, gains = load_rig(self.rig).joint_names, np.array(self.joint_gains)
        low, high = int(np.argmin(gains)), int(np.argmax(gains))
        return f"{gains[low]:.2f} ({joints[low]}) to {gains[high]:.2f} ({joints[high]})"

    @property
    def fixed_told(self) -> str:
        """What is fixed, in words: "mass 0.86 kg"."""
        units = {p.name: p.unit for p in parameters_of(self.rig, self.effects)} if self.fixed else {}
        return ", ".join(f"{name} {with_unit(f'{v:g}', units[name])}" for name, v in self.fixed.items()) or "nothing"

    @property
    def made_by(self) -> str:
        """What made this version: "diagnosis", "inference", "remove", "fix", "prior" (a new effect), "built in"."""
        e = self.evidence
        made = e.get("kind") or ("inference" if e.get("inference") else "fix" if "fixed" in e else "")
        return made or ("prior" if self.parent else "built in")

    @property
    def fit(self) -> Fit:
        """What the particles come from; those that were kept from another version have that one's fit."""
        e, kept = self.evidence, self.evidence.get("kept", {})
        inference = e.get("inference") or {}
        seen = {*e.get("rollouts", ()), *inference.get("rollouts", ()), *kept.get("rollouts", ())}
        by = inference.get("method") or e.get("kind") or kept.get("by", "")
        return Fit(sorted(seen), by, inference.get("fits", kept.get("fits", True)))

    def uses(self) -> list[EffectUse]:
        """The effects in this model."""
        return uses_of(load_rig(self.rig), self.effects)

    def mean(self) -> np.ndarray:
        """(P,) weighted means, on each parameter's own scale (a geometric mean for log scales)."""
        units = np.stack(
            [p.to_unit(column) for p, column in zip(self.parameters, self.particles.T, strict=True)], axis=-1
        )
        return self.from_unit(self.weights @ units)

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """(count, P) draws from the particles."""
        return self.particles[rng.choice(len(self.particles), size=count, p=self.weights)]

    def to_unit(self, values: np.ndarray) -> np.ndarray:
        """(..., P) physical -> unit cube, where the prior is uniform."""
        return np.stack([p.to_unit(values[..., i]) for i, p in enumerate(self.parameters)], axis=-1)

    def from_unit(self, units: np.ndarray) -> np.ndarray:
        """(..., P) unit cube -> physical."""
        return np.stack([p.from_unit(units[..., i]) for i, p in enumerate(self.parameters)], axis=-1)

    def with_effect(self, key: str) -> "Model":
        """An unsaved child with one more effect, whose parameters follow their prior.

        Raises:
          SimError: unknown effect, or one that the model has or the rig cannot have.
        """
        if key in self.effects:
            raise SimError(
                f"model {self.version!r} has the effect {key!r} already, allowed is one that it lacks; fit its size "
                "again with ./tcbi infer, or name an earlier version with --model"
            )
        use = find_use(key, load_rig(self.rig))
        rng = np.random.default_rng([len(self.effects), zlib.crc32(use.key.encode())])  # not the base model's draws
        new = np.stack([p.sample(rng, len(self.particles)) for p in use.parameters], axis=-1)
        return dataclasses.replace(
            self,
            version=f"{self.version}+{key}",
            effects=(*self.effects, use.key),
            parameters=self.parameters + use.parameters,
            particles=np.concatenate([self.particles, new], axis=1),
            parent=self.saved_version,
            evidence=self._kept(),
            created=now(),
        )

    def without_effect(self, key: str) -> "Model":
        """An unsaved child without one effect: the marginal of the joint distribution over all other parameters.

        What the others had been fitted to beside the effect stays in them; only another fit would change that.

        Args:
          key: "name:site", or "name" where the model has the effect at one place.

        Raises:
          UnknownNameError: the model has no such effect, or at several places.
        """
        named = [use for use in self.effects if key in (use, use.partition(":")[0])]
        if len(named) != 1:
            raise UnknownNameError(f"effect of {self.version}", key, self.effects)
        gone = f"{named[0]}."
        kept = [i for i, name in enumerate(self.names) if not name.startswith(gone)]
        fixed = {name: value for name, value in self.fixed.items() if not name.startswith(gone)}
        return dataclasses.replace(
            self,
            version=f"{self.saved_version}-{named[0]}",
            effects=tuple(use for use in self.effects if use != named[0]),
            parameters=tuple(self.parameters[i] for i in kept),
            particles=self.particles[:, kept],
            parent=self.saved_version,
            evidence=self._kept(),
            created=now(),
            fixed=fixed,
        )

    def with_fixed(self, values: Mapping[str, float]) -> "Model":
        """An unsaved child in which parameters stay at values that were measured otherwise, as a mass with scales.

        They are fitted no more. The others keep their distribution, which was not fitted beside these values.

        Args:
          values: physical, by the parameters' names.

        Raises:
          UnknownNameError: the model has no such parameter, or it is fixed already.
          SimError: a value outside its parameter's range, or no parameter would be left.
        """
        for name in values:
            if name not in self.names:
                raise UnknownNameError(f"parameter of {self.version}", name, self.names)
        kept = [i for i, name in enumerate(self.names) if name not in values]
        return dataclasses.replace(
            self,
            version=f"{self.saved_version}+fixed",
            parameters=tuple(self.parameters[i] for i in kept),
            particles=self.particles[:, kept],
            parent=self.saved_version,
            evidence={**self._kept(), "fixed": dict(values)},
            created=now(),
            fixed={**self.fixed, **values},
        )

    def with_free(self, names: Collection[str]) -> "Model":
        """An unsaved child in which fixed parameters are fitted again; until then they are as wide as their priors.

        Raises:
          UnknownNameError: one of them is not fixed.
        """
        for name in names:
            if name not in self.fixed:
                raise UnknownNameError(f"fixed parameter of {self.version}", name, tuple(self.fixed))
        fixed = {name: value for name, value in self.fixed.items() if name not in names}
        parameters = parameters_of(self.rig, self.effects, fixed)
        known = dict(zip(self.names, self.particles.T, strict=True))
        rng = np.random.default_rng([1, zlib.crc32(" ".join(sorted(names)).encode())])
        columns = [known[p.name] if p.name in known else p.sample(rng, len(self.particles)) for p in parameters]
        return dataclasses.replace(
            self,
            version=f"{self.saved_version}+free",
            parameters=parameters,
            particles=np.stack(columns, axis=-1),
            parent=self.saved_version,
            evidence={**self._kept(), "fixed": {}},
            created=now(),
            fixed=fixed,
        )

    def with_particles(self, particles: np.ndarray, log_weights: np.ndarray | None = None, **evidence: Any) -> "Model":
        """An unsaved child with another distribution of the same parameters."""
        if log_weights is None:
            log_weights = np.full(len(particles), -np.log(len(particles)))
        return dataclasses.replace(
            self,
            version=f"{self.saved_version}+",
            particles=particles,
            log_weights=log_weights,
            parent=self.saved_version,
            evidence=evidence,
            created=now(),
        )

    def _kept(self) -> dict[str, Any]:
        """Evidence of a child that keeps these particles, which is no fit of the child's."""
        return {"kept": self.fit._asdict()} if self.fit.rollouts else {}


def uses_of(rig: Rig, effects: Iterable[str]) -> list[EffectUse]:
    """The effects of a model of a rig.

    Raises:
      SimError: unknown effect, or one that the rig cannot have.
    """
    return [find_use(key, rig) for key in effects]


def parameters_of(name: str, effects: Iterable[str], fixed: Collection[str] = ()) -> tuple[Parameter, ...]:
    """The parameters that a rig and effects define, but for those that are fixed, in the order of a model's.

    Raises:
      SimError: unknown rig or effect, or an effect that the rig cannot have.
    """
    rig = load_rig(name)
    every = rig.parameters + tuple(p for use in uses_of(rig, effects) for p in use.parameters)
    return tuple(p for p in every if p.name not in fixed)


def now() -> str:
    """The present time, ISO 8601, UTC."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def base_model(rig: Rig | str) -> Model:
    """Version 0 of a rig: no effects, every parameter as wide as its prior."""
    rig = load_rig(rig) if isinstance(rig, str) else rig
    rng = np.random.default_rng(0)
    particles = np.stack([p.sample(rng, PRIOR_PARTICLES) for p in rig.parameters], axis=-1)
    return Model(
        f"{rig.name}-v0", rig.name, (), rig.parameters, particles, np.full(PRIOR_PARTICLES, -np.log(PRIOR_PARTICLES))
    )
