"""What a diagnosis says: evidence for each candidate, and a verdict that never sounds surer than the data."""

import dataclasses
import math
from typing import Any

import numpy as np

EFFECT, CANNOT_TELL = "effect", "cannot_tell"
NOTHING_MISSING, OUTSIDE_LIBRARY = "nothing_missing", "outside_library"


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """A fitted parameter with its 90 % interval."""

    name: str
    unit: str
    value: float
    low90: float
    high90: float
    null: float | None

    @property
    def excludes_null(self) -> bool:
        """Whether the interval stays away from where the effect vanishes; False for a parameter without a null."""
        return self.null is not None and not self.low90 <= self.null <= self.high90


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What the rollouts say about one candidate.

    Attributes:
      effect: name in the library; `use` adds the place, as in "weak_leg:lm".
      elpd_gain: held-out gain of log score in nats, summed over kinds of motion; `elpd_se` its standard error.
      statistic: gain over its standard error, both per kind of motion.
      error_before: error over noise floor on rollouts that no fit saw, base model refitted.
      error_after: the same with the effect.
      refined: fitted by simulation; else only screened, and the figures are a linear estimate.
      alike: uses that change the signals in nearly the same way.
      confused_with: those, and uses that explain these rollouts about as well.
      values: (P,) parameters of the whole model with the effect, physical; empty where not refined.
      spread: (P, P) their covariance in unit space.
    """

    effect: str
    use: str
    elpd_gain: float
    elpd_se: float
    statistic: float
    error_before: float
    error_after: float
    parameters: tuple[ParameterEstimate, ...]
    refined: bool
    converged: bool
    accepted: bool = False
    reason: str = ""
    confused_with: tuple[str, ...] = ()
    alike: tuple[str, ...] = ()
    gains: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    spread: tuple[tuple[float, ...], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        return {**dataclasses.asdict(self), "parameters": [dataclasses.asdict(p) for p in self.parameters]}


@dataclasses.dataclass(frozen=True)
class Moment:
    """A piece of one signal, predicted by fits that had not seen its kind of motion; arrays are (T,) in `unit`."""

    signal: str
    unit: str
    rollout: str
    time: np.ndarray  # s
    measured: np.ndarray
    before: np.ndarray  # base model
    after: np.ndarray | None  # with the best candidate
    floor: float


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The verdict and everything that it rests on.

    Attributes:
      effects: names of the effects that the verdict names; `uses` with their places.
      statement: the verdict in a sentence.
      threshold: of the statistic, from simulations of "nothing missing".
      errors: the ladder: label -> error over noise floor, on rollouts that no fit saw.
      untestable: uses that change nothing in these rollouts.
      moments: where the base model fails worst, with and without the best candidate.
      claims: caveats in sentences: how the data were split, what no claim is made about.
    """

    model: str
    verdict: str
    effects: tuple[str, ...]
    uses: tuple[str, ...]
    statement: str
    ranking: tuple[Evidence, ...]
    seconds: float
    rollouts: tuple[str, ...]
    sealed: tuple[str, ...]
    threshold: float
    errors: dict[str, float]
    floor_from_replicates: bool
    untestable: tuple[str, ...]
    guards: tuple[str, ...]
    claims: tuple[str, ...]
    base: Evidence
    moments: tuple[Moment, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        fields = {
            f.name: getattr(self, f.name)
            for f in dataclasses.fields(self)
            if f.name not in ("moments", "ranking", "base")
        }
        ranking = [e.to_json() for e in self.ranking]
        return _plain({**fields, "ranking": ranking, "base": self.base.to_json()})


def _plain(value: Any) -> Any:
    """Tuples to lists, numpy to Python, NaN and infinity to None, so that any JSON reader takes it."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (np.bool_, np.integer)):
        return value.item()
    return value
