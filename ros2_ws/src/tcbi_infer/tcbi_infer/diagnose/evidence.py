"""What a diagnosis says: evidence for each candidate, and a verdict that never sounds surer than the data."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tcbi_contract.plain import plain
from tcbi_contract.wording import with_unit

EFFECT, CANNOT_TELL = "effect", "cannot_tell"
NOTHING_MISSING, OUTSIDE_LIBRARY = "nothing_missing", "outside_library"
WELL_PREDICTED = 3.0  # times the noise floor; of 20 emulated robots with nothing hidden one left more
EXPLAINED = 1 / 3  # of the excess error: a candidate that explains less leaves "something else is missing" open
HEADLINES = {
    EFFECT: "An effect is missing",
    CANNOT_TELL: "An effect is missing, but which one cannot be told",
    NOTHING_MISSING: "Nothing is missing that these rollouts could show",
    OUTSIDE_LIBRARY: "Something is missing that the library does not hold",
}
UNEXPLAINED = "Something is missing that no effect tried explains"  # where the library was not tried as a whole
PARTLY = "Something is missing, of which little is explained"
NOT_CONVERGED = "The fit of the model did not converge"


@dataclasses.dataclass(frozen=True)
class Misfit:
    """Error over the noise floor on motions held out: of all together, and of each kind by the name of a rollout.

    Attributes:
      attitude: of each kind, of roll and pitch alone, which are few beside the joints; empty where none was measured.
    """

    total: float
    by_kind: dict[str, float] = dataclasses.field(default_factory=dict)
    attitude: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def badly_predicted(self) -> int:
        """Kinds of motion that err by more than WELL_PREDICTED."""
        return sum(error > WELL_PREDICTED for error in self.by_kind.values())


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """A fitted parameter with its 90 % interval.

    Attributes:
      at_bound: the fit stopped at an end of the range that is not the null value: the interval is one-sided.
      cut_off: the fit did not, but the interval ends at such an end, and might be wider.
      low, high: the ends of the parameter's range.
    """

    name: str
    unit: str
    value: float
    low90: float
    high90: float
    null: float | None
    at_bound: bool = False
    cut_off: bool = False
    low: float = float("-inf")
    high: float = float("inf")

    @property
    def excludes_null(self) -> bool:
        """Whether the interval stays away from where the effect vanishes; False for a parameter without a null."""
        return self.null is not None and not self.low90 <= self.null <= self.high90

    def to_json(self) -> dict[str, Any]:
        """The fields, and whether the interval leaves the null value out (None without one)."""
        return {**dataclasses.asdict(self), "excludes_null": self.excludes_null if self.null is not None else None}


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What the rollouts say about one candidate.

    Attributes:
      effect: name in the library; `use` adds the place, as in "weak_leg:lm".
      elpd_gain: held-out gain of log score in nats, of all kinds of motion (`paired.total`); `elpd_se` its error.
      statistic: sum of the square roots of the kinds' gains over its standard error (`paired.statistic`).
      error_before: error over noise floor on rollouts that no fit saw, base model refitted.
      error_after: the same with the effect.
      held_out: error over noise floor before and after, of the open motions alone, each predicted without its own kind.
      elsewhere: errors over noise floor before and after of the other signals that fits look at, by their names, on
        rollouts that no fit saw.
      refined: fitted by simulation; else only screened, and the figures are a linear estimate.
      gains: of each kind of motion, in nats; `sizes` the replicate sets of each.
      alike: uses that change the signals in nearly the same way.
      confused_with: those, and uses that explain these rollouts about as well.
      values: (P,) parameters of the whole model with the effect, physical; empty where not refined.
      spread: (P, P) their covariance in unit space.
      joint_gains: (J,) each servo's own stiffness beside them, as `Model.joint_gains`; empty where none was fitted.
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
    held_out: tuple[float, float] | None = None
    elsewhere: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    gains: tuple[float, ...] = ()
    sizes: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    spread: tuple[tuple[float, ...], ...] = ()
    joint_gains: tuple[float, ...] = ()

    @property
    def explains_little(self) -> bool:
        """Of an error that is large, on the sealed motions and on those held out in turn, as far as both are known."""
        pairs = [(self.error_before, self.error_after), self.held_out or (self.error_before, self.error_after)]
        return all(before > WELL_PREDICTED and before - after < EXPLAINED * (before - 1.0) for before, after in pairs)

    def sizes_in_words(self) -> str:
        """Its parameters with their 90 % intervals, for a table."""
        told = [
            with_unit(f"{p.name.rpartition('.')[2]} {p.value:.3g} ({p.low90:.3g} to {p.high90:.3g})", p.unit)
            + (", at the end of its range" if p.at_bound else "")
            for p in self.parameters
        ]
        return "; ".join(told) or "screened only"

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        return {**dataclasses.asdict(self), "parameters": [p.to_json() for p in self.parameters]}


def in_doubt(base_converged: bool, error: float, ranking: Sequence[Evidence]) -> bool:
    """Whether what a base model gets wrong, and what candidates gain on it, may be the fault of its own fit.

    Args:
      base_converged: whether that fit did.
      error: of the base model over the noise floor, on the motions held out in turn.
      ranking: candidates, acceptance decided.
    """
    return not base_converged and (error > WELL_PREDICTED or any(e.accepted for e in ranking))


@dataclasses.dataclass(frozen=True)
class Moment:
    """A piece of one signal, predicted by fits that had not seen its kind of motion; arrays are (T,) in `unit`."""

    signal: str
    unit: str
    rollout: str
    time: np.ndarray  # s
    measured: np.ndarray
    before: np.ndarray  # base model
    after: dict[str, np.ndarray]  # with each candidate that got a full fit
    floor: float


@dataclasses.dataclass(frozen=True)
class DetectableSize:
    """The smallest size of an effect that the rollouts could have shown, in four of five recordings like these.

    Attributes:
      use: "name" or "name:site".
      parameter: the one that is moved, its qualified name; "" for a use that changes nothing.
      value: of the parameter, in `unit`, nearest to `null`, where the effect vanishes; None where no size is shown.
      share: distance from the null value, of the parameter's range.
      limit: which of the requirements decides.
      reason: why no size is shown, or "".
      place: parameters without a null value for which this holds; "" where it holds for all that were tried.
    """

    use: str
    parameter: str = ""
    unit: str = ""
    null: float | None = None
    value: float | None = None
    share: float = math.nan
    limit: str = ""
    reason: str = ""
    place: str = ""

    @property
    def effect(self) -> str:
        """Name in the library."""
        return self.use.partition(":")[0]


@dataclasses.dataclass(frozen=True)
class FalseAlarms:
    """How often the search finds something in simulated data sets in which nothing is missing.

    Attributes:
      statement: in a sentence.
      data_sets: simulated.
      rate: share of them; None where none is claimed, and so for `low90` and `high90`.
    """

    statement: str
    data_sets: int = 0
    rate: float | None = None
    low90: float | None = None
    high90: float | None = None


@dataclasses.dataclass(frozen=True)
class NextMotion:
    """A motion that could be recorded next, and what is expected of it.

    Attributes:
      motion: its name, such as "gait:twist"; `description` in words.
      between: the two uses whose models it is to tell apart; "" is the model without any.
      nats: expected log-likelihood ratio, whichever of the two is right.
      duration_s: its length.
      command: of the shell, that records it; "" where the rig has no recorder here.
      table: then the commands themselves, rows of time (s) and targets (rad).
    """

    motion: str
    description: str
    between: tuple[str, str]
    nats: float
    duration_s: float
    command: str = ""
    table: tuple[tuple[float, ...], ...] = ()


@dataclasses.dataclass(frozen=True)
class Variable:
    """What a law of one recorded variable explains of what a model leaves.

    Attributes:
      share: of the joints' squared error beyond the noise, in motions held out; beyond a constant offset's share.
      se: its standard error, from how far kinds of motion differ.
      sure: the kinds of motion agree that it explains something, and that is worth a word.
    """

    name: str
    share: float
    se: float
    sure: bool


@dataclasses.dataclass(frozen=True)
class Leftover:
    """How much of a model's error in the joints' positions goes with anything recorded.

    Attributes:
      statement: in a sentence.
      use: the effect that the model has besides the base model; "" for none.
      share: of the squared error beyond the noise that laws of all variables explain; None where it cannot be told.
      variables: each alone, the most telling first.
    """

    statement: str
    use: str = ""
    share: float | None = None
    variables: tuple[Variable, ...] = ()


@dataclasses.dataclass(frozen=True)
class KindValue:
    """What one kind of motion alone would have a parameter be, with its 90 % interval."""

    kind: str
    value: float
    low90: float
    high90: float


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Whether the kinds of motion agree on a parameter.

    Attributes:
      value: common to all.
      agrees: None where too few kinds know the parameter, or shifts in time cannot tell.
      statement: in a sentence.
      kinds: those that know it alone.
      p: how often errors of this size, unrelated to the parameter, scatter the values as far; None where not tested.
    """

    name: str
    unit: str
    value: float
    agrees: bool | None
    statement: str
    kinds: tuple[KindValue, ...]
    p: float | None = None


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The verdict and everything that it rests on.

    Attributes:
      effects: names of the effects that the verdict names; `uses` with their places.
      statement: the verdict in a sentence.
      threshold: of the statistic, from simulations of "nothing missing".
      errors: the ladder: label -> error over noise floor, on rollouts that no fit saw.
      misfit: of the base model, refitted (each open kind of motion held out in turn) or as it was, if that is better.
      kinds: of motion, the sealed ones left out; 0 where that was not told.
      untestable: uses that change nothing in these rollouts.
      untried: uses of the library that were not tried.
      unsteady: that the robot does not repeat itself, in a sentence; empty where it does.
      to_mend: what is wrong with the recordings, for which no effect was tried.
      moments: where the base model fails worst, with and without the candidates.
      claims: caveats in sentences: how the data were split, what no claim is made about.
      false_alarms: how often the search alone raises one, as simulated for this robot and these rollouts.
      detectable: the smallest size of each effect that these rollouts could have shown, or why none.
      next_motions: what to record where the rollouts cannot tell, or to show an effect that was asked for; best
        first of each pair that they tell apart.
      leftover: what the error of the model that the verdict rests on goes with.
      agreement: use ("" the base model) -> whether the kinds of motion agree on each parameter of the fitted model.
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
    false_alarms: FalseAlarms | None = None
    detectable: tuple[DetectableSize, ...] = ()
    next_motions: tuple[NextMotion, ...] = ()
    leftover: Leftover | None = None
    agreement: dict[str, tuple[Agreement, ...]] = dataclasses.field(default_factory=dict)
    misfit: Misfit | None = None
    kinds: int = 0
    untried: tuple[str, ...] = ()
    unsteady: str = ""
    to_mend: tuple[str, ...] = ()

    @property
    def headline(self) -> str:
        """The verdict in a few words, no surer than the statement: what was not accepted may be missing, no more."""
        if not self.reassuring and self.verdict == NOTHING_MISSING:
            return "No effect is named, but not every motion is predicted"
        if self.untried and self.verdict == OUTSIDE_LIBRARY:
            return UNEXPLAINED
        if self.verdict != CANNOT_TELL:
            return HEADLINES[self.verdict]
        if self.to_mend:
            return "The recordings look wrong: no effect was tried"
        if self.nothing_held_out or (self.unsteady and not self.uses):
            return "These rollouts cannot tell"
        if in_doubt(self.base.converged, (self.base.held_out or (self.base.error_before,))[0], self.ranking):
            return NOT_CONVERGED
        accepted = [e for e in self.ranking if e.accepted]
        if accepted and all(e.explains_little for e in accepted):
            return PARTLY
        return HEADLINES[CANNOT_TELL] if accepted else "An effect may be missing"

    @property
    def reassuring(self) -> bool:
        """Whether nothing is missing, and the motions are predicted well."""
        return self.verdict == NOTHING_MISSING and not (self.misfit and self.misfit.total > WELL_PREDICTED)

    @property
    def nothing_held_out(self) -> bool:
        """Whether the rollouts had one kind of motion only, so that every error is of the motion of the fit itself."""
        return self.kinds == 1

    def to_json(self) -> dict[str, Any]:
        """The keys of the contract, and a few more."""
        fields = {
            f.name: getattr(self, f.name)
            for f in dataclasses.fields(self)
            if f.name not in ("moments", "ranking", "base")
        }
        ranking = [e.to_json() for e in self.ranking]
        return plain({
            "headline": self.headline, "nothing_held_out": self.nothing_held_out,
            "reassuring": self.reassuring,
            **fields, "ranking": ranking, "base": self.base.to_json(),
        })  # fmt: skip


def step_label(name: str) -> str:
    """What a step of the error ladder is called: `unfitted`, `base`, or the uses of effects added."""
    return {"unfitted": "model as it was", "base": "model, parameters fitted"}.get(name, f"with {name}")
