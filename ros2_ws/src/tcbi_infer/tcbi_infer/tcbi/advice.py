"""What to record next: the motion that would tell what these rollouts leave open, parameter by parameter.

    for advice in advise(problem, result):
        advice.parameter, advice.motion, advice.left, advice.command

Draws of the posterior are simulated on motions that are ready to be recorded. Were the motion recorded, its statistics
would tell the parameter as well as they do among these draws: a ridge regression of the parameter on them, judged on
the draws left out one by one, leaves a share of its variance unexplained. Simulations alone would tell anything, so
the statistics get noise first: as much as the recorded rollouts differ from their own simulations. Where the inference
compares motions in time, so does the advice: by the directions in which the draws' motions differ most, with as much
noise as makes a normal likelihood of how the inference weighs them.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.names import SLOPE_LIMIT
from tcbi_infer.diagnose.motions import STILL, Motion, gait_motion, ready_motions
from tcbi_infer.errors import InferError
from tcbi_infer.statistics import RolloutArrays, Statistic, failing, from_measurements, samples
from tcbi_infer.tcbi.calibration import LARGEST_ALPHA
from tcbi_infer.tcbi.in_time import Differences, means_of, stretches
from tcbi_infer.tcbi.prior import Prior
from tcbi_infer.tcbi.problem import Problem, Simulated, differences_of
from tcbi_infer.tcbi.result import IDENTIFIED_BELOW, LEAST_ESS, Result
from tcbi_policy.gaits import GAITS
from tcbi_policy.reward import inclination
from tcbi_sim.engine import simulate
from tcbi_sim.rigs import load_rig

DRAWS = 60  # of the posterior, on every motion
FEWEST = 30  # of them that a regression is made of
REPEATS = 2  # that a motion is recorded, as its command does
FALLEN, MOST_FALLEN = 1.0, 0.1  # rad of inclination; share of the draws
STIFFNESS = np.geomspace(1e-4, 1e3, 15)  # of the regression, times the features' mean square
WELL_WEIGHED = 0.5  # share of what the data support, below which tempering makes most of a posterior's variance
LEAST_ALPHA = 1e-4  # where rollouts contradict each other however little they weigh
TINY = 1e-9  # noise of motions that the model reproduces to the last bit, in their unit


@dataclass(frozen=True)
class Advice:
    """What to record for a parameter that the data do not identify."""

    parameter: str
    left: float  # expected share of its present variance, on the parameter's scale
    tells: bool  # whether that is little enough; if not, no motion that was tried would tell it
    motion: str = ""  # the best one
    description: str = ""
    command: str = ""  # of the shell; "" where the rig has no recorder of its own

    def line(self) -> str:
        """For people."""
        if not self.motion:
            return f"{self.parameter}: no motion could be tried"
        best = f"{self.motion} ({self.description})"
        if not self.tells:
            return (
                f"{self.parameter}: none of the motions that were tried would tell; the best, {best}, would leave "
                f"{self.left:.0%} of its variance"
            )
        return f"{self.parameter}: {best} would leave {self.left:.0%} of its variance" + (
            f"\n  {self.command}" if self.command else ""
        )

    def as_json(self) -> dict[str, Any]:
        """Every field."""
        return asdict(self)


def hindrance(result: Result) -> str:
    """ "" or why no advice can be given."""
    if result.fits is None:
        return (
            "no advice on what to record: too few particles or generations to tell whether the model fits; "
            "take more generations first"
        )
    if not result.fits:
        return "no advice on what to record: the model fits poorly, and an effect may be missing (./tcbi diagnose)"
    if result.ess < LEAST_ESS:
        return f"no advice on what to record: fewer than {LEAST_ESS} effective particles; take more generations first"
    return ""


def caution(result: Result) -> str:
    """ "" or why less may come of the advice than it promises: particles are too few for the data at hand already."""
    last = _last(result)
    supported, alpha = last.get("alpha_supported"), last.get("alpha")
    if not supported or alpha is None or alpha >= WELL_WEIGHED * supported:
        return ""
    return (
        f"with so few particles the data are weighed at {alpha / supported:.0%} of what they support, and a recording "
        "tells less than is promised: more generations come first, and may tell these parameters by themselves"
    )


def advise(
    problem: Problem,
    result: Result,
    progress: Callable[[float, str], None] = lambda share, motion: None,
    motions: Sequence[Motion] | None = None,
) -> tuple[Advice, ...]:
    """The best motion for each parameter that is not identified.

    Args:
      problem: the rollouts at hand.
      result: what was inferred from them.
      progress: called with the share done and the motion at work.
      motions: to choose from; those that `candidates` finds by default.
    """
    unsure = [i for i, e in enumerate(result.estimates) if not e.identified]
    if not unsure or hindrance(result):
        return ()
    tried = candidates(problem) if motions is None else motions
    rng = np.random.default_rng(problem.seed)
    unit = Prior.of(result.updated_model()).unit(rng.random((DRAWS, len(problem.model.names))))
    left_over = residuals(problem, result)
    left = np.full((len(tried), len(unsure)), np.nan)  # where too few simulations stayed upright to tell
    for k, motion in enumerate(tried):
        progress(k / len(tried), motion.name)
        kept, seen = statistics_of(problem, motion, unit, left_over, rng)
        if len(kept) >= FEWEST:
            left[k] = [unexplained(seen, unit[kept, i]) for i in unsure]
    progress(1.0, "")
    return tuple(_best(result.estimates[i].name, left[:, j], tried) for j, i in enumerate(unsure))


def _best(parameter: str, left: np.ndarray, motions: Sequence[Motion]) -> Advice:
    if not np.isfinite(left).any():
        return Advice(parameter, 1.0, False)
    k = int(np.nanargmin(left))
    m, share = motions[k], float(left[k])
    return Advice(parameter, share, share < IDENTIFIED_BELOW, m.name, m.description, m.command)


def candidates(problem: Problem) -> list[Motion]:
    """Motions that are ready, and gaits on a slope half way between the steepest recorded one and the limit."""
    measurements = [m for group in problem.groups for m in group.measurements]
    ready = ready_motions(load_rig(problem.model.rig), measurements)
    if not any(motion.name.startswith("gait:") for motion in ready):
        return ready
    steepest = max(max(abs(m.scenario.slope_roll), abs(m.scenario.slope_pitch)) for m in measurements)
    slope = round((steepest + SLOPE_LIMIT) / 2, 2)
    words = f"; on a slope of {np.degrees(slope):.0f}°"
    steep = [gait_motion(name, 0.0, slope, ready[0].scenario.duration) for name in GAITS if name not in STILL]
    return [*ready, *(replace(motion, description=motion.description + words) for motion in steep)]


def features(statistic: Statistic, arrays: RolloutArrays) -> np.ndarray:
    """(N, S, 2 C) mean and standard deviation of each channel in each rollout, NaN where it has no sample."""
    values = samples(statistic, arrays)
    known = np.isfinite(values)
    count = np.where(known.any(axis=-1), known.sum(axis=-1), np.nan)
    mean = np.where(known, values, 0.0).sum(axis=-1) / count
    square = (np.where(known, values - mean[..., None], 0.0) ** 2).sum(axis=-1) / count
    return np.concatenate([mean, np.sqrt(square)], axis=-1)


class Residuals(NamedTuple):
    """What the recorded rollouts differ by from their own simulations with the parameters that fit best."""

    features: dict[str, np.ndarray]  # statistic -> (2 C,) root mean square over the rollouts
    in_time: Differences
    alpha: float  # that the data support, or the largest where the method knows none

    def sd_in_time(self, problem: Problem, seconds: float) -> np.ndarray:
        """(K,) standard deviation, in its unit, of a mean over a tenth of a second in a motion of so many seconds.

        It makes a normal likelihood of what the inference weighs motions by.
        """
        observed = problem.observed.in_time._replace(stretches=REPEATS * stretches(seconds))
        noise, freedom = observed.noise(self.in_time, 0)
        return np.sqrt(observed.scale(noise / freedom) / (2 * self.alpha))


def residuals(problem: Problem, result: Result) -> Residuals:
    """With the best particle, in time with short steps where the inference corrects to them; with the mean if none is.

    Raises:
      InferError: the simulation diverges.
    """
    last = _last(result)
    unit = np.array(last.get("best", [np.exp(result.log_weights) @ result.unit])[:1])
    simulated, finer = problem.rollouts(unit), (problem.finer or problem).rollouts(unit)
    if not simulated.valid[0]:
        raise InferError("no advice on what to record: with the parameters that fit best the simulation diverges")
    return Residuals(
        _of_features(problem, simulated),
        differences_of(problem, finer if finer.valid[0] else simulated),
        max(last.get("alpha_supported", LARGEST_ALPHA), LEAST_ALPHA),
    )


def _last(result: Result) -> dict[str, Any]:
    return result.generations[-1] if result.generations else {}


def _of_features(problem: Problem, simulated: Simulated) -> dict[str, np.ndarray]:
    """Statistic -> (2 C,) root mean square, over the rollouts, of measured minus one simulation's features."""
    found = {}
    for statistic in problem.statistics:
        apart = [
            features(statistic, group.arrays)[0] - features(statistic, arrays)[0]
            for group, arrays in zip(problem.groups, simulated.readings, strict=True)
        ]
        square = np.concatenate(apart) ** 2
        known = np.isfinite(square)
        found[statistic.name] = np.sqrt(np.where(known, square, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))
    return found


def statistics_of(
    problem: Problem, motion: Motion, unit: np.ndarray, left_over: Residuals, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Which (n,) of (M, P) draws have statistics of a motion, and these (n, F), noise added and in units of it."""
    out = simulate(
        problem.model, problem.model.from_unit(unit), [motion.scenario], commands=[motion.commands],
        timestep=problem.timestep, rate=problem.rate, threads=problem.threads,
    )  # fmt: skip
    upright = np.ones(len(unit), bool)
    if out.attitude is not None:
        upright = np.nan_to_num(inclination(out.attitude[:, 0]), nan=np.inf).max(axis=-1) < FALLEN
    if upright.mean() < 1 - MOST_FALLEN:
        return np.zeros(0, int), np.zeros((0, 0))
    kept = np.flatnonzero(upright & ~out.diverged[:, 0])
    recorded = [replace(out.measurement(n), commands=motion.commands) for n in kept.tolist()]
    exact = from_measurements(recorded, recorded[0].time)
    arrays = problem.read(exact, [rng])
    columns = []
    for statistic in problem.statistics:
        with failing(statistic):
            if statistic.missing(arrays):
                continue
        values, sd = features(statistic, arrays)[0], left_over.features[statistic.name]
        usable = (sd > 0) & np.isfinite(values).all(axis=0)
        columns.append(values[:, usable] / sd[usable] + rng.standard_normal((len(kept), usable.sum())) / REPEATS**0.5)
    seconds = motion.scenario.duration
    for statistic, sd_in_time in zip(problem.followed, left_over.sd_in_time(problem, seconds), strict=True):
        with failing(statistic):
            if statistic.missing(exact):
                continue
        columns.append(directions(means_of(statistic, exact)[0], sd_in_time, rng))
    return kept, np.concatenate(columns, axis=1) if columns else np.zeros((len(kept), 0))


def directions(motion: np.ndarray, sd: float, rng: np.random.Generator) -> np.ndarray:
    """(n, D) of (n, C, K) motions along the directions in which they differ by more than the noise, noise added.

    In units of the noise, `sd` for each value, which is the same in every direction. An inference knows the directions
    from simulations without noise; a regression on n draws with noise in all values would not find them.
    """
    flat = np.nan_to_num(motion.reshape(len(motion), -1))
    scores, size, _ = np.linalg.svd((flat - flat.mean(axis=0)) / max(sd, TINY), full_matrices=False)
    told = size**2 / len(flat) > 1 / REPEATS
    return scores[:, told] * size[told] + rng.standard_normal((len(flat), told.sum())) / REPEATS**0.5


def unexplained(seen: np.ndarray, value: np.ndarray) -> float:
    """Share of the variance of (n,) values that a ridge regression on (n, F) features leaves, one by one left out."""
    x, y, n = seen - seen.mean(axis=0), value - value.mean(), len(value)
    kernel = x @ x.T
    scale = np.trace(kernel) / n
    if scale <= 0 or y.var() <= 0:
        return 1.0
    shares = []
    for stiffness in STIFFNESS:
        hat = np.linalg.solve(kernel + stiffness * scale * np.eye(n), kernel) + 1 / n
        shares.append(np.mean(((y - hat @ y) / (1 - np.diag(hat))) ** 2) / y.var())
    return float(min(1.0, *shares))
