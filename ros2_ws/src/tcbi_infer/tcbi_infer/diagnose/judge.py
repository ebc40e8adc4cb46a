"""What a fit is worth: its error on motions that it has not seen, its intervals, its gain over the base model.

judge = Judge(model, problem, split, floor, timestep)
before, after = judge.judge(base), judge.judge(fit)
judge.evidence("backlash", after, before, drift)
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from tcbi_infer.compare.comparison import error_over_floor
from tcbi_infer.compare.locate import worst_moments
from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replicates import Split
from tcbi_infer.compare.signals import ATTITUDE, GROUPS, JOINT, Group
from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.evidence import Evidence, Misfit, Moment, ParameterEstimate
from tcbi_infer.diagnose.fit import Fit
from tcbi_infer.diagnose.heldout import HeldOut, fold_indices, held_out, intervals
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.scatter import joint_gains
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

AT_BOUND = 0.01  # of a range


@dataclasses.dataclass(frozen=True)
class Judged:
    """A fit and its predictions of motions that it was not fitted to."""

    fit: Fit
    held: HeldOut
    error: float  # over the noise floor, on motions that no fit saw
    elsewhere: dict[str, float]  # the same of each other kind of signal that fits look at, by its name


class Judge:
    """Judges fits of one problem, all in the same way.

    Attributes:
      unfitted: error over the floor of the model as it was, on the sealed motions, or on all where none are sealed.
    """

    def __init__(
        self,
        model: Model,
        problem: Problem,
        split: Split,
        floor: NoiseFloor,
        timestep: float,
    ) -> None:
        self.model, self.problem, self.replay, self.split, self.floor = model, problem, problem.replay, split, floor
        self.timestep = timestep
        self.sets = np.array(split.open, int)
        self.sizes = np.array([len(fold) for fold in fold_indices(problem, self.sets)])
        unseen = list(split.sealed) or list(self.sets)
        self.unfitted = self._error(self.replay.predict(model, model.mean()[None], unseen, timestep)[0], unseen)

    @property
    def sealed(self) -> list[Measurement]:
        """The rollouts that no fit and no search has seen: the verdict alone looks at them."""
        return [self.replay.measurements[m] for s in self.split.sealed for m in self.replay.replicates[s].members]

    def judge(self, fit: Fit) -> Judged:
        """Predict each kind of motion from the others, and the sealed motions from all."""
        held = held_out(self.problem, fit, self.sets, self.timestep)
        predicted, sets = self._unseen(fit, held)
        elsewhere = {
            group.name: self._error(predicted, sets, group)
            for group in GROUPS
            if group.fitted and group not in (JOINT, ATTITUDE) and self._measured(sets, group)
        }
        return Judged(fit, held, self._error(predicted, sets), elsewhere)

    def held_out_error(self, judged: Judged) -> float:
        """Error over the floor of the open motions, each predicted without its own kind.

        Infinite also where the fit diverges in a motion that it was fitted to.
        """
        if not judged.fit.total < np.inf:
            return np.inf
        return self._error(self.problem.observed[self.sets] - judged.held.residual, list(self.sets))

    def misfit(self, judged: Judged) -> Misfit:
        """Of the open motions, each predicted without its own kind."""
        predicted = self.problem.observed[self.sets] - judged.held.residual
        return Misfit(self.held_out_error(judged), self._by_kind(predicted), self._by_kind(predicted, ATTITUDE))

    def unfitted_misfit(self) -> Misfit:
        """Of the open motions too, by the model as it was, never fitted."""
        sets = list(self.sets)
        predicted = self.replay.predict(self.model, self.model.mean()[None], sets, self.timestep)[0]
        return Misfit(self._error(predicted, sets), self._by_kind(predicted), self._by_kind(predicted, ATTITUDE))

    def _by_kind(self, predicted: np.ndarray, *groups: Group) -> dict[str, float]:
        """Errors of predictions (open sets, T, C); infinite where one diverged, left out where nothing was measured.

        With `groups`, of these signals alone.
        """
        found: dict[str, float] = {}
        for number, fold in enumerate(fold_indices(self.problem, self.sets), 1):
            sets = self.sets[fold]
            if not self._measured(sets, *groups):
                continue
            first = self.replay.measurements[self.replay.replicates[sets[0]].members[0]]
            name = f"{first.rollout_id} ({first.policy_id or f'motion {number}'})"
            found[name] = self._error(predicted[fold], list(sets), *groups)
        return found

    def _unseen(self, fit: Fit, held: HeldOut) -> tuple[np.ndarray, list[int]]:
        """Predicted (sets, T, C) sealed motions, cross-validated open ones where none are sealed; and which these are.

        Each servo has its own gain.
        """
        sealed = list(self.split.sealed)
        if sealed:
            model = dataclasses.replace(fit.model, joint_gains=joint_gains(fit))
            return self.replay.predict(model, fit.parameters[None], sealed, self.timestep)[0], sealed
        return self.problem.observed[self.sets] - held.residual, list(self.sets)

    def _measured(self, sets: Sequence[int], *groups: Group) -> bool:
        """Whether any of these signals was measured in some sets, as of `_error`."""
        channels = self.replay.layout.where(*(groups or (JOINT, ATTITUDE)))
        return bool(self.problem.weight[sets][..., channels].any())

    def _error(self, predicted: np.ndarray, sets: Sequence[int], *groups: Group) -> float:
        """Of predictions (sets, T, C); infinite where one diverged; of joints and attitude, or of `groups`."""
        pairs = [(m, i) for i, s in enumerate(sets) for m in self.replay.replicates[s].members]
        members, owners = map(list, zip(*pairs, strict=True))
        measured, counted = self.replay.measured[members], groups or (JOINT, ATTITUDE)
        return error_over_floor(self.replay.layout, measured, predicted[owners], self.floor.values, counted)

    def evidence(self, use: str, after: Judged, before: Judged, drift: np.ndarray) -> Evidence:
        """What the rollouts say of a use that was fitted; with "" of the base model itself.

        Args:
          use: which.
          after: with the effect.
          before: the base model.
          drift: (P,) how far the optimum may still move as the time step goes to zero, in ranges.
        """
        fit = after.fit
        with np.errstate(invalid="ignore"):  # where both diverged
            gains = after.held.score - before.held.score
        gain, se = paired.total(gains, self.sizes)
        low, high, covariance = intervals(fit, after.held, drift, after.error)
        units = zip(fit.unit, low, high, strict=True)
        parameters = tuple(estimate(p, *unit) for p, unit in zip(fit.model.parameters, units, strict=True))
        return Evidence(
            effect=use.partition(":")[0],
            use=use,
            elpd_gain=float(gain),
            elpd_se=float(se),
            statistic=float(paired.statistic(gains, self.sizes)),
            error_before=before.error,
            error_after=after.error,
            parameters=parameters[len(before.fit.unit) :] if use else parameters,
            refined=True,
            converged=fit.converged,
            held_out=(self.held_out_error(before), self.held_out_error(after)),
            elsewhere={name: (before.elsewhere[name], error) for name, error in after.elsewhere.items()},
            gains=tuple(float(g) for g in gains),
            sizes=tuple(int(s) for s in self.sizes),
            names=fit.model.names,
            values=tuple(float(v) for v in fit.parameters),
            spread=tuple(tuple(float(x) for x in row) for row in covariance),
            joint_gains=joint_gains(fit),
        )

    def moments(self, before: Judged, after: Mapping[str, Judged], count: int = 4, span_s: float = 1.5) -> list[Moment]:
        """Where the base model fails worst on held-out motions, with and without each of some uses."""
        layout, residual = self.replay.layout, before.held.residual
        span = round(span_s * layout.rate)
        found = []
        for s, t, c in worst_moments(residual, self.floor.values, layout.where(JOINT), count, span):
            cut = slice(t, t + span)
            observed = self.problem.observed[self.sets[s], cut, c]
            group = self.replay.replicates[self.sets[s]]
            found.append(
                Moment(
                    layout.channels[c].name,
                    layout.channels[c].group.unit,
                    self.replay.measurements[group.members[0]].rollout_id,
                    self.replay.time[cut],
                    observed,
                    observed - residual[s, cut, c],
                    {use: observed - judged.held.residual[s, cut, c] for use, judged in after.items()},
                    float(self.floor.values[c]),
                )
            )
        return found


def estimate(parameter: Parameter, unit: float, low: float, high: float) -> ParameterEstimate:
    """A parameter's estimate from its fitted value and its interval's ends, each in [0, 1]."""
    value, low90, high90 = (float(parameter.from_unit(x)) for x in (unit, low, high))
    stopped = at_bound(parameter, unit)
    cut_off = not stopped and any(at_bound(parameter, end) for end in (low, high))
    return ParameterEstimate(
        parameter.name, parameter.unit, value, low90, high90, parameter.null, stopped, cut_off, parameter.low,
        parameter.high,
    )  # fmt: skip


def at_bound(parameter: Parameter, unit: float) -> bool:
    """Whether a value in [0, 1] stands at an end of the range that is not the null value."""
    null = None if parameter.null is None else float(parameter.to_unit(parameter.null))
    return any(abs(unit - end) < AT_BOUND and (null is None or abs(null - end) >= AT_BOUND) for end in (0.0, 1.0))


def screened(use: str, gains: np.ndarray, sizes: np.ndarray, error_before: float) -> Evidence:
    """The linear estimate (F,) in nats of a use that got no full fit, kinds of motion holding `sizes` (F,) sets."""
    gain, se = paired.total(gains, sizes)
    return Evidence(
        effect=use.partition(":")[0],
        use=use,
        elpd_gain=float(gain),
        elpd_se=float(se),
        statistic=float(paired.statistic(gains, sizes)),
        error_before=error_before,
        error_after=float("nan"),
        parameters=(),
        refined=False,
        converged=False,
        gains=tuple(float(g) for g in gains),
        sizes=tuple(int(s) for s in sizes),
    )
