"""Whether to believe a posterior: a model that fits poorly, a rollout unlike the others, a bound that is in the way."""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tcbi_infer.tcbi.method import Generation
from tcbi_infer.tcbi.predictive import DEPARTED, Departures
from tcbi_infer.tcbi.servos import Scattered
from tcbi_infer.tcbi.weights import normalised
from tcbi_sim.parameter import Parameter

EDGE = 0.02  # share of the range that counts as a bound
PILED = 0.5  # share of the posterior at a bound that is worth a line
MISFIT = 4.0  # remaining divergence over noise, in the mean of a statistic's channels, that is worth a warning
MISFIT_OF_ONE = 6.0  # the same of a single channel
OFF = 16.0  # times what a servo leaves of it on average, that one leaves which is off by four standard deviations
STRAY = 4.0  # times as much as the rollout in the middle, that predictions miss one which is unlike the others
STRAYS = 0.2  # share of the rollouts, beyond which they are no exceptions
LEAST_OTHERS = 4  # rollouts, with fewer of which none is unlike the others
NEAR = 0.05  # of a bound, in shares of the range, lie most of the best particles where it may be in the way
OVERSHOOT = 0.1  # beyond a bound, in shares of the range, from which predictions would rather lie there
REACHED = 0.05  # share of a posterior at a bound, from which the bound may cut it off
UNLIKELY = 0.05  # share of a prior that is not flat, beyond which they lie where that prior may be in the way
POOR = 1.8  # remaining divergence over noise, from which a bound is said to be in the way
FALLING = 0.1  # share by which that ratio falls in a generation, from which more of them may still mend it
WIDENED = (
    "the posterior is widened for it; an effect may be missing (tcbi diagnose), a parameter's range be too narrow, or "
    "the rollouts not be of one robot in one state"
)
TOO_NARROW = "its range, in the file of the rig or of its effect, is too narrow, or an effect is missing"
PUSHED = (
    "one of these may lie there only to make up for another: widen one range at a time, first the one that you are "
    "least sure of"
)
UNTOLD = (
    "too few particles or generations to tell whether the model fits: more of them may still lower what remains of the "
    "divergence of {}"
)


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
    departed: Departures | None = None,
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
      departed: how far the predictions are off. Where they are too far the posterior widens until it allows for it.
    """
    ratios, single = dict(zip(statistics, _misfit_ratios(last), strict=False)), last.notes.get("misfit", {})
    earlier = {} if before is None else dict(zip(statistics, _misfit_ratios(before), strict=False))
    falling = _falling(ratios, earlier) | _falling(single, {} if before is None else before.notes.get("misfit", {}))
    outside = _outside(parameters, departed.nearest) if departed else {}
    ends = {
        end.parameter.name: f"the prior of {end.parameter.name} seems to exclude the data: what fits best lies "
        f"{end.near} its {end.at}, and fits poorly; {TOO_NARROW}"
        for end in _ends(parameters, unit, log_weights, last)
        if not end.null and (end.share > PILED or end.best)
    }
    beyond, excluded = ({}, []) if prior is None else _beyond(parameters, last, prior)
    bounds = list((ends | outside | beyond).values())
    poor = {name: ratio for name, ratio in ratios.items() if ratio > POOR}
    large = {name: ratio for name, ratio in ratios.items() if ratio > MISFIT} | _worst_channels(single, ratios)
    far = departed.far if departed else {}
    stays_poor = bool(poor.keys() - falling)
    if len(bounds) > 1:
        bounds.append(PUSHED)
    told = stays_poor or bool(excluded)
    lines = list(bounds) if told else []
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
    lines = [*(bounds if far and not told else []), *lines]
    lines += [
        f"no parameters reproduce {name} in time: predictions with the best of them miss the robot's by "
        f"{math.degrees(d.error):.2g} deg, {d.missed:.1f} times as much as each other's; {WIDENED}"
        for name, d in far.items()
    ]
    return GoodnessOfFit(lines, not lines, max([1.0, distrust, *(d.apart**2 for d in far.values())]))


def in_doubt(statistics: Sequence[str], last: Generation) -> bool:
    """Whether so much remains of a divergence that the model may be called wrong for it."""
    ratios = dict(zip(statistics, _misfit_ratios(last), strict=False))
    return max(ratios.values(), default=0.0) > MISFIT or bool(_worst_channels(last.notes.get("misfit", {}), ratios))


def allowing(generation: Generation, servos: Scattered) -> Generation:
    """The same with ratios as if rollouts differed by as much as servos do, and a channel's by `OFF` as much."""
    notes = generation.notes
    noise = np.array(notes["floor_noise"]) * np.maximum(servos.statistics, 1.0)
    over = {name: max(1.0, OFF / MISFIT_OF_ONE * servos.channels.get(name, 0.0)) for name in notes["misfit"]}
    misfit = {name: ratio / over[name] for name, ratio in notes["misfit"].items()}
    return generation._replace(notes={**notes, "floor_noise": noise.tolist(), "misfit": misfit})


def strays(departed: Departures, rollouts: Sequence[str]) -> list[str]:
    """A line for each of the few rollouts that predictions miss far more than the others.

    Args:
      departed: how far the predictions are off.
      rollouts: R ids, in the order of the departures.
    """
    lines: dict[str, str] = {}
    for name, departure in departed.signals.items() if len(rollouts) >= LEAST_OTHERS else ():
        over = np.array(departure.rollouts) / max(np.median(departure.rollouts), np.finfo(float).tiny)
        unlike = np.flatnonzero((over > STRAY) & (np.array(departure.rollouts) > DEPARTED[name])).tolist()
        for r in unlike if len(unlike) <= max(1, STRAYS * len(rollouts)) else ():
            lines.setdefault(
                rollouts[r],
                f"{rollouts[r]} is unlike the other rollouts: predictions miss its {name} {over[r]:.0f} times as much "
                "as those of the rollout in the middle; it was spoilt (tcbi compare shows how), and is better left "
                "out, or it shows something that the others do not",
            )
    return list(lines.values())


def _outside(parameters: Sequence[Parameter], nearest: Sequence[float]) -> dict[str, str]:
    """A line for each parameter beyond whose range predictions (P,) come nearest, but for its null value."""
    lines = {}
    for p, at in zip(parameters, nearest, strict=len(nearest) > 0):
        way, end = ("above", p.high) if at > 0.5 else ("below", p.low)
        if p.null != end and abs(at - 0.5) > 0.5 + OVERSHOOT:
            lines[p.name] = (
                f"the prior of {p.name} seems to exclude the data: predictions come nearest to the robot's motion with "
                f"values {way} its end of {end:g}{_unit(p)}; {TOO_NARROW}"
            )
    return lines


def _beyond(parameters: Sequence[Parameter], last: Generation, prior: np.ndarray) -> tuple[dict[str, str], list[str]]:
    """A line for each parameter whose best values mostly lie beyond what draws (N, P) of the prior lead to expect.

    And which of them lie beyond every draw, which no good fit makes up for.
    """
    best, lines, excluded = np.asarray(last.notes.get("best", [])), {}, []
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
                f"prior expects {least} to {most}{_unit(p)} ({1 - 2 * UNLIKELY:.0%}); take the flat prior, or an "
                "effect is missing"
            )
            if not prior[:, i].min() <= middle <= prior[:, i].max():
                excluded.append(p.name)
    return lines, excluded


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


def piled(
    parameters: Sequence[Parameter],
    unit: np.ndarray,
    log_weights: np.ndarray,
    last: Generation,
    told: Container[str] = (),
) -> list[str]:
    """A line for each parameter whose posterior piles up at a bound; of a wrong model, only where it is null there.

    Of parameters that the data tell (`told`) it is enough that the 90 % interval reaches a bound that is not null.
    """
    lines = []
    for end in _ends(parameters, unit, log_weights, last):
        reached = not end.null and end.parameter.name in told and end.share > REACHED
        if (end.share > PILED or reached) and (end.null or not _fits_poorly(last)):
            absent = (
                "where the effect is absent"
                if end.null
                else "which may cut it off; a wider range (in the file of the rig or of its effect) would tell"
            )
            does = "piles up at" if end.share > PILED else "reaches"
            lines.append(f"the posterior of {end.parameter.name} {does} its {end.at}, {absent}")
    return lines


class _End(NamedTuple):
    """One end of a parameter's range, and what lies there."""

    parameter: Parameter
    at: str  # "low end, 0 rad"
    null: bool  # whether the effect vanishes there
    share: float  # of the posterior, at the bound
    best: bool  # whether most of the best particles are near
    near: str  # "at", or where in the middle these lie: "at 5.2 N m/rad, near"


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
            near = bool(len(best)) and bool(np.median(far_best) < NEAR)
            middle = float(p.from_unit(np.median(best[:, i]))) if near else bound
            where = "at" if f"{middle:.2g}" == f"{bound:.2g}" else f"at {middle:.2g}{_unit(p)}, near"
            share = float(weights[far < EDGE].sum())
            yield _End(p, f"{name} end, {bound:g}{_unit(p)}", p.null == bound, share, near, where)


def unfinished(last: Generation) -> list[str]:
    """A line if too few particles carry weight for what the data support."""
    supported = last.notes.get("alpha_supported")
    if not supported or last.alpha >= 0.99 * supported:
        return []
    share = last.alpha / supported
    return [
        f"more could be learnt: with {int(last.ess)} effective particles the data are weighed at {share:.0%} of "
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
