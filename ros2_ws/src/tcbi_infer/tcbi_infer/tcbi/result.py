"""What an inference found: weighted particles, a table with a verdict per parameter, and what a user must know."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from tcbi_infer.tcbi.method import Generation
from tcbi_infer.tcbi.predictive import JOINTS, TILTS, Departure
from tcbi_infer.tcbi.weights import effective_sample_size, mean_and_variance, normalised, quantiles, resample
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

FLAT_VARIANCE = 1.0 / 12.0  # of a flat prior on [0, 1]
IDENTIFIED_BELOW = 0.5  # of the prior's variance, with 95 % confidence
LEAST_ESS = 10  # effective particles, below which nothing is said about what the data tell
EDGE = 0.02  # share of the range that counts as a bound
PILED = 0.5  # share of the posterior at a bound that is worth a line
MISFIT = 4.0  # remaining divergence over noise, in the mean of a statistic's channels, that is worth a warning
MISFIT_OF_ONE = 6.0  # the same of a single channel
# times as much as each other's, that predictions miss the robot's motion: the same
DEPARTED = {JOINTS: 2.0, TILTS: 4.0}
# rad: missing less is of no account, however much it stands out; about what the encoders of small servos resolve
NEGLIGIBLE = {JOINTS: 0.006, TILTS: 0.0045}
STRAY = 4.0  # times as much as the rollout in the middle, that predictions miss one which is unlike the others
STRAYS = 0.2  # share of the rollouts, beyond which they are no exceptions
LEAST_OTHERS = 4  # rollouts, with fewer of which none is unlike the others
NEAR = 0.05  # of a bound, in shares of the range, lie all of the best particles where it may be in the way
UNLIKELY = 0.05  # share of a prior that is not flat, beyond which they lie where that prior may be in the way
POOR = 1.8  # remaining divergence over noise, from which a bound is said to be in the way
FALLING = 0.1  # share by which that ratio falls in a generation, from which more of them may still mend it
WIDENED = "the posterior is widened for it, and an effect may be missing (tcbi diagnose)"
UNTOLD = (
    "too few particles or generations to tell whether the model fits: more of them may still lower what remains of the "
    "divergence of {}"
)


@dataclass(frozen=True)
class Estimate:
    """One parameter's posterior, in physical units."""

    name: str
    unit: str
    mean: float
    sd: float
    low90: float
    high90: float
    prior_sd: float
    variance_ratio: float  # posterior over prior variance, on the parameter's scale
    identified: bool  # whether the data say something about it

    def as_json(self) -> dict[str, Any]:
        """As the contract has it, and a little more."""
        keys = ("name", "unit", "mean", "sd", "low90", "high90", "identified", "variance_ratio")
        return {key: getattr(self, key) for key in keys}


@dataclass(frozen=True)
class Result:
    """The outcome of one inference."""

    model: Model  # whose structure was inferred
    method: str
    task: str
    statistics: tuple[str, ...]
    rollouts: tuple[str, ...]
    unit: np.ndarray  # (M, P) in [0, 1]
    log_weights: np.ndarray  # (M,) normalised
    estimates: tuple[Estimate, ...]
    ess: float  # effective sample size of the distinct particles
    simulations: int  # rollouts simulated
    seconds: float  # wall time of all generations, those before it was resumed among them
    generations: tuple[dict[str, Any], ...]  # one entry each: mean, variance, ess, alpha, divergence, wall_s; the last
    # one has the moments of this posterior
    converged: bool
    closed_loop: bool
    warnings: tuple[str, ...]
    prior: np.ndarray | None = None  # (N, P) draws in [0, 1] of the prior that was used; None for the flat one
    fits: bool | None = True  # no sign that the model is wrong; None: the search was too short to tell
    state: Path | None = None  # from which an interrupted inference goes on; of no use once this is saved
    settings: Mapping[str, Any] = field(default_factory=dict)  # seed, timestep (s), the method's own, versions

    @property
    def particles(self) -> np.ndarray:
        """(M, P) physical values."""
        return self.model.from_unit(self.unit)

    @property
    def divergence(self) -> dict[str, float]:
        """Weighted mean divergence of each statistic, at the end."""
        values = self.generations[-1]["divergence"] if self.generations else []
        return dict(zip(self.statistics, values, strict=False))

    def draws(self, count: int, seed: int = 0) -> np.ndarray:
        """(count, P) equally weighted physical values."""
        rng = np.random.default_rng(seed)
        return self.particles[rng.permutation(resample(rng, np.exp(self.log_weights), count))]

    def forget_state(self) -> None:
        """Remove the state from which an interrupted inference goes on."""
        if self.state is not None:
            self.state.unlink(missing_ok=True)

    def updated_model(self) -> Model:
        """An unsaved child of the model whose particles are the posterior, with the evidence that made it."""
        seen = [] if self.prior is None else self.model.fit.rollouts
        return self.model.with_particles(
            self.particles,
            self.log_weights,
            inference={
                "method": self.method,
                "task": self.task,
                "rollouts": list(self.rollouts),
                "statistics": list(self.statistics),
                "closed_loop": self.closed_loop,
                "settings": dict(self.settings),
                "prior": "flat" if self.prior is None else self.model.version,
                "fits": self.fits,
                "parameters": [e.as_json() for e in self.estimates],
                "ess": self.ess,
                "simulations": self.simulations,
                "seconds": self.seconds,
                "converged": self.converged,
                "warnings": list(self.warnings),
            },
            **({"kept": {"rollouts": seen}} if seen else {}),
        )


def estimates(
    parameters: Sequence[Parameter],
    unit: np.ndarray,
    log_weights: np.ndarray,
    prior: np.ndarray | None = None,
    judged: bool = True,
) -> tuple[Estimate, ...]:
    """The table.

    Args:
      parameters: P.
      unit: (M, P) particles in [0, 1].
      log_weights: (M,).
      prior: (N, P) draws of it, None for flat.
      judged: whether the particles' spread is what the data leave open; if not, no parameter is called identified.
    """
    weights = normalised(log_weights)
    enough = judged and effective_sample_size(weights) >= LEAST_ESS
    before = prior_variances(len(parameters), prior)
    _, variance = mean_and_variance(unit, weights)
    high = _variance_bound(unit, weights)
    sds = prior_sds(parameters, prior)
    rows = []
    for i, p in enumerate(parameters):
        values = p.from_unit(unit[:, i])
        mean, spread = mean_and_variance(values[:, None], weights)
        low90, high90 = quantiles(values[:, None], weights, [0.05, 0.95])[:, 0]
        rows.append(
            Estimate(
                p.name,
                p.unit,
                float(mean[0]),
                float(np.sqrt(spread[0])),
                float(low90),
                float(high90),
                sds[i],
                float(variance[i] / before[i]),
                bool(enough and high[i] / before[i] < IDENTIFIED_BELOW),
            )
        )
    return tuple(rows)


def prior_variances(count: int, prior: np.ndarray | None = None) -> np.ndarray:
    """(count,) in [0, 1] before the data: of (N, count) draws, or flat."""
    return np.full(count, FLAT_VARIANCE) if prior is None else prior.var(axis=0)


def prior_sds(parameters: Sequence[Parameter], prior: np.ndarray | None = None) -> list[float]:
    """Standard deviation of each parameter in its unit before the data: of (N, P) draws in [0, 1], or flat."""
    draws = np.tile((np.arange(1000)[:, None] + 0.5) / 1000, len(parameters)) if prior is None else prior
    return [float(p.from_unit(draws[:, i]).std()) for i, p in enumerate(parameters)]


def _variance_bound(unit: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Upper 95 % bound (P,) of the variance, as if the effective sample size were draws of a normal distribution."""
    size = max(effective_sample_size(weights), 2.0)
    _, variance = mean_and_variance(unit, weights)
    return variance * size / (2.0 * gammaincinv((size - 1) / 2.0, 0.05))  # quantile of chi-squared


class GoodnessOfFit(NamedTuple):
    """How well the model fits."""

    lines: list[str]  # one for each reason to doubt it
    fits: bool | None  # None: the search was too short to tell
    distrust: float  # how many times less the data's say should count for it, 1 where nothing is wrong


def goodness_of_fit(
    parameters: Sequence[Parameter],
    unit: np.ndarray,
    log_weights: np.ndarray,
    statistics: Sequence[str],
    last: Generation,
    before: Generation | None,
    prior: np.ndarray | None = None,
    departed: Mapping[str, Departure] | None = None,
) -> GoodnessOfFit:
    """Whether the model fits, by what remains of its divergences and by its predictions.

    Args:
      parameters: P.
      unit: (M, P) particles in [0, 1].
      log_weights: (M,).
      statistics: names.
      last: generation.
      before: the generation before it, None if there was none.
      prior: (N, P) draws of it in [0, 1], None for flat.
      departed: of `predictive.departures`. The model is wrong where it misses a signal by more than `DEPARTED` and
        `NEGLIGIBLE`, and by more than the posterior's width allows for; then the posterior widens until it does.
    """
    ratios, single = dict(zip(statistics, _misfit_ratios(last), strict=False)), last.notes.get("misfit", {})
    earlier = {} if before is None else dict(zip(statistics, _misfit_ratios(before), strict=False))
    falling = _falling(ratios, earlier) | _falling(single, {} if before is None else before.notes.get("misfit", {}))
    beyond = {} if prior is None else _beyond(parameters, last, prior)
    bounds = list(beyond.values()) + [
        f"the prior of {end.parameter.name} seems to exclude the data: what fits best lies at its {end.at}, "
        "and fits poorly; its range, in the file of the rig or of its effect, is too narrow, or an effect is missing"
        for end in _ends(parameters, unit, log_weights, last)
        if not end.null and (end.share > PILED or end.best) and end.parameter.name not in beyond
    ]
    poor = {name: ratio for name, ratio in ratios.items() if ratio > POOR}
    large = {name: ratio for name, ratio in ratios.items() if ratio > MISFIT} | _worst_channels(single, ratios)
    far = {name: d for name, d in (departed or {}).items() if _is_far(name, d)}
    stays_poor = bool(poor.keys() - falling)
    lines = list(bounds) if stays_poor else []
    lines += [
        f"no parameters reproduce {name}: what remains of its divergence is {ratio:.0f} times what rollouts differ by; "
        f"{WIDENED}"
        for name, ratio in large.items()
        if name not in falling
    ]
    untold = [name for name in (large | poor if bounds and not far else large) if name in falling]
    if untold and not lines:
        return GoodnessOfFit([UNTOLD.format(", ".join(untold))], None, 1.0)
    distrust = worst_misfit(last) if lines else 1.0
    lines = [*(bounds if far and not stays_poor else []), *lines]
    lines += [
        f"no parameters reproduce {name} in time: predictions with the best of them miss the robot's by "
        f"{math.degrees(d.error):.2g} deg, {d.missed:.1f} times as much as each other's; {WIDENED}"
        for name, d in far.items()
    ]
    return GoodnessOfFit(lines, not lines, max([1.0, distrust, *(d.apart**2 for d in far.values())]))


def _is_far(signal: str, departure: Departure) -> bool:
    stands_out = departure.missed > DEPARTED[signal] and departure.apart > 1.0
    return stands_out and departure.error > NEGLIGIBLE[signal]


def strays(departed: Mapping[str, Departure], rollouts: Sequence[str]) -> list[str]:
    """A line for each of the few rollouts that predictions miss far more than the others.

    Args:
      departed: of `predictive.departures`.
      rollouts: R ids, in the order of the departures.
    """
    lines: dict[str, str] = {}
    for name, departure in departed.items() if len(rollouts) >= LEAST_OTHERS else ():
        over = np.array(departure.rollouts) / max(np.median(departure.rollouts), np.finfo(float).tiny)
        unlike = np.flatnonzero((over > STRAY) & (np.array(departure.rollouts) > DEPARTED[name]))
        for r in unlike if len(unlike) <= max(1, STRAYS * len(rollouts)) else ():
            lines.setdefault(
                rollouts[r],
                f"{rollouts[r]} is unlike the other rollouts: predictions miss its {name} {over[r]:.0f} times as much "
                "as those of the rollout in the middle; it was spoilt (tcbi compare shows how), and is better left "
                "out, or it shows something that the others do not",
            )
    return list(lines.values())


def _beyond(parameters: Sequence[Parameter], last: Generation, prior: np.ndarray) -> dict[str, str]:
    """A line for each parameter whose best values mostly lie beyond what draws (N, P) of the prior lead to expect."""
    best, lines = np.asarray(last.notes.get("best", [])), {}
    low, high = np.quantile(prior, [UNLIKELY, 1 - UNLIKELY], axis=0)
    for i, p in enumerate(parameters if len(best) else ()):
        # a prior that reaches to the null value has the effect absent among what it expects
        middle = float(np.median(best[:, i]))
        below = middle < low[i] and not (p.null == p.low and low[i] < NEAR)
        above = middle > high[i] and not (p.null == p.high and 1 - high[i] < NEAR)
        if below or above:
            found, least, most = (f"{p.from_unit(unit):.3g}" for unit in (middle, low[i], high[i]))
            lines[p.name] = (
                f"the prior of {p.name} seems to exclude the data: what fits best has {found}{_unit(p)}, where the "
                f"prior expects {least} to {most}{_unit(p)} ({1 - 2 * UNLIKELY:.0%}), and fits poorly; take the flat "
                "prior, or an effect is missing"
            )
    return lines


def _unit(parameter: Parameter) -> str:
    """As it stands behind a value."""
    return "" if parameter.unit in ("", "1") else f" {parameter.unit}"


def _worst_channels(single: Mapping[str, float], ratios: Mapping[str, float]) -> dict[str, float]:
    """Of each statistic that fits in the mean of its channels, the channel that does not, the worst of them."""
    worst = {}
    for channel in sorted(single, key=lambda name: single[name]):
        statistic, _, _ = channel.partition("/")
        if single[channel] > MISFIT_OF_ONE and ratios[statistic] <= MISFIT:
            worst[statistic] = channel
    return {channel: single[channel] for channel in worst.values()}


def _falling(ratios: Mapping[str, float], earlier: Mapping[str, float]) -> set[str]:
    """What remained less of than a generation ago; all of it where there was none."""
    return {name for name, ratio in ratios.items() if ratio < (1 - FALLING) * earlier.get(name, np.inf)}


def piled(parameters: Sequence[Parameter], unit: np.ndarray, log_weights: np.ndarray, last: Generation) -> list[str]:
    """A line for each parameter whose posterior piles up at a bound; of a wrong model, only where it is null there."""
    lines = []
    for end in _ends(parameters, unit, log_weights, last):
        if end.share > PILED and (end.null or not _fits_poorly(last)):
            absent = (
                "where the effect is absent"
                if end.null
                else "which may cut it off; a wider range (in the file of the rig or of its effect) would tell"
            )
            lines.append(f"the posterior of {end.parameter.name} piles up at its {end.at}, {absent}")
    return lines


class _End(NamedTuple):
    """One end of a parameter's range, and what lies there."""

    parameter: Parameter
    at: str  # "low end, 0 rad"
    null: bool  # whether the effect vanishes there
    share: float  # of the posterior, at the bound
    best: bool  # whether all of the best particles are near


def _ends(
    parameters: Sequence[Parameter], unit: np.ndarray, log_weights: np.ndarray, last: Generation
) -> Iterator[_End]:
    best = np.asarray(last.notes.get("best", np.empty((0, len(parameters)))))
    weights = normalised(log_weights)
    for i, p in enumerate(parameters):
        for name, bound, far, far_best in (
            ("low", p.low, unit[:, i], best[:, i]),
            ("high", p.high, 1 - unit[:, i], 1 - best[:, i]),
        ):
            near = bool(len(best)) and bool(np.all(far_best < NEAR))
            share = float(weights[far < EDGE].sum())
            yield _End(p, f"{name} end, {bound:g}{_unit(p)}", p.null == bound, share, near)


def unfinished(last: Generation) -> list[str]:
    """A line if too few particles carry weight for what the data support."""
    supported = last.notes.get("alpha_supported")
    if not supported or last.alpha >= 0.99 * supported:
        return []
    share = last.alpha / supported
    return [
        f"more could be learnt: with {last.ess:.0f} effective particles the data are weighed at {share:.0%} of "
        "what they support, so the posterior is wider than need be; more generations narrow it"
    ]


def worst_misfit(last: Generation) -> float:
    """How many times as much remains of a divergence as rollouts differ by: the worst statistic or channel."""
    return max([*_misfit_ratios(last), *last.notes.get("misfit", {}).values()], default=1.0)


def _fits_poorly(last: Generation) -> bool:
    return max(_misfit_ratios(last), default=0.0) > POOR


def _misfit_ratios(last: Generation) -> list[float]:
    """Remaining divergence over what rollouts differ by, of each statistic; empty where the method knows neither."""
    noise, misfit = last.notes.get("floor_noise", []), last.notes.get("floor_misfit", [])
    return [m / max(n, 1e-9) for n, m in zip(noise, misfit, strict=True)]
