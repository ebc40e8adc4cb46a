"""How good a policy is on draws of a model, and whether one is better than another.

conditions = draw_conditions(model, "balance", 64, seed=1)
before, after = (evaluate(policy, model, conditions) for policy in (old, new))
comparison = compare_paired(before, after, confidence=0.975)
comparison.better        # with that confidence
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from tcbi_contract.wording import counted
from tcbi_policy.artefact import Actor
from tcbi_policy.blocks import OverBlocks, over_blocks
from tcbi_policy.environment import TIMESTEP_S
from tcbi_policy.layout import HEXAPOD, check_fit, robot_layout
from tcbi_policy.mlp import Mlp
from tcbi_policy.reward import inclination, progress, simulated_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig
from tcbi_sim.tasks import find_task

LEAST_SHARE, LEAST_PAIRS = 0.9, 8  # of the rollouts of a comparison that must end under both policies


def check_rig(policy: str, model: Model) -> None:
    """Refuse a model of a robot that no policy or gait of these tasks can move.

    Raises:
      PolicyMisfit: everything that differs, by name.
    """
    rig = load_rig(model.rig)
    robot, remedy = robot_layout(rig.joint_names, rig.joint_range), "name a model of the hexapod with --model"
    check_fit(f"{policy} (on {model.version})", HEXAPOD, robot, remedy)


@dataclass(frozen=True)
class Conditions:
    """n pairs of physical parameters and scenario; every policy that is compared meets the same."""

    parameters: np.ndarray  # (n, P)
    scenarios: list[Scenario]


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of one policy; NaN where a simulation diverged, or a step's reward is not a number."""

    returns: np.ndarray  # (n,)
    inclination: np.ndarray  # (n,) rad, at the end
    distance: np.ndarray  # (n,) m along the heading at the start
    over_blocks: OverBlocks | None = None  # None where no scenario has blocks

    @property
    def mean_return(self) -> float:
        """Mean over the simulations that have a return; NaN if none has."""
        return _of_finite(np.mean, self.returns)

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Of the mean return, Student's t over the simulations that have one; NaN with fewer than two."""
        known = self.returns[~np.isnan(self.returns)]
        if len(known) < 2:
            return math.nan, math.nan
        reach = float(stdtrit(len(known) - 1, (1 + confidence) / 2) * np.std(known, ddof=1) / math.sqrt(len(known)))
        return self.mean_return - reach, self.mean_return + reach

    def summary(self) -> dict[str, float]:
        """Means and spreads, in degrees and m; where there are blocks, also who went over one or past all of them."""
        degrees = np.degrees(self.inclination)
        return {
            "rollouts": len(self.returns),
            "mean_return": self.mean_return,
            "sd_return": _of_finite(np.std, self.returns),
            "final_inclination_deg": _of_finite(np.mean, degrees),
            "distance_m": _of_finite(np.mean, self.distance),
            "median_distance_m": _of_finite(np.median, self.distance),
            "diverged": int(np.isnan(self.returns).sum()),
        } | self._blocks()

    def _blocks(self) -> dict[str, float]:
        """How many rollouts went over a block, how many with a foot, and the mean distance of those and the others.

        Over how many blocks a rollout put its feet, in the mean; and the share of all that left the last block behind,
        with the mean time until they did.
        """
        if self.over_blocks is None:
            return {}
        ended = np.isfinite(self.distance)
        foot = ended & (self.over_blocks.feet > 0)
        either = foot | (ended & self.over_blocks.trunk)
        groups = {"distance_over_blocks_m": either, "distance_not_over_blocks_m": ended & ~either}
        past = ended & np.isfinite(self.over_blocks.past_s)
        found: dict[str, float] = {"over_blocks": int(either.sum()), "foot_over_blocks": int(foot.sum())}
        found |= {name: float(self.distance[group].mean()) for name, group in groups.items() if group.any()}
        found["blocks_under_feet"] = _of_finite(np.mean, np.where(ended, self.over_blocks.feet, np.nan))
        found["past_blocks_share"] = float(past.mean())
        return found | ({"past_blocks_s": float(self.over_blocks.past_s[past].mean())} if past.any() else {})


def _of_finite(statistic: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    """A statistic of the values that are not NaN; NaN if all are."""
    known = values[~np.isnan(values)]
    return float(statistic(known)) if len(known) else math.nan


def draw_conditions(model: Model, task: str, count: int, seed: int, *, systematic: bool = False) -> Conditions:
    """Draws of a model's parameters and a task's scenarios, a function of the seed.

    Args:
      model: with its particles.
      task: whose scenarios are drawn.
      count: how many.
      seed: of all draws.
      systematic: each parameter vector is drawn as often as its weight says, to within one, instead of independently.
    """
    rng = np.random.default_rng([seed, 104729])
    parameters = _systematic(model, rng, count) if systematic else model.sample(rng, count)
    return Conditions(parameters, [find_task(task).draw(rng, int(rng.integers(2**31))) for _ in range(count)])


def _systematic(model: Model, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, P) draws at equal steps of the cumulative weight, over the particles in lexicographic order."""
    order = np.lexsort(model.particles.T[::-1])
    marks = (rng.random() + np.arange(count)) / count
    rows = np.searchsorted(np.cumsum(model.weights[order]), marks).clip(max=len(order) - 1)
    return model.particles[order[rows]]


def evaluate(
    actor: Actor, model: Model, conditions: Conditions, timestep: float = TIMESTEP_S, threads: int = 0
) -> Evaluation:
    """Roll a policy out, once in each condition."""
    parameters, scenarios = conditions.parameters, conditions.scenarios
    out = simulate(
        model, parameters, scenarios, controller=actor, pairing="zip", timestep=timestep, threads=threads
    )  # fmt: skip
    assert out.attitude is not None and out.position is not None
    lost = out.diverged[:, 0]
    heading = np.array([s.initial_yaw for s in conditions.scenarios])
    ends = (inclination(out.attitude[:, 0, -1]), progress(out.position[:, 0], heading)[:, -1])
    returns = simulated_rewards(out)[:, 0].sum(axis=-1)  # of one task, hence of one duration
    tilt, distance = (np.where(lost, np.nan, values) for values in ends)
    return Evaluation(returns, tilt, distance, over_blocks(out) if any(s.blocks for s in scenarios) else None)


def step_spread(actor: Actor, model: Model, conditions: Conditions, timestep: float, threads: int = 0) -> float:
    """Standard deviation of a control step's reward under a policy."""
    out = simulate(
        model, conditions.parameters, conditions.scenarios, controller=actor, pairing="zip",
        timestep=timestep, threads=threads,
    )  # fmt: skip
    return float(np.nanstd(simulated_rewards(out)))


@dataclass(frozen=True)
class Network:
    """A bare network as a controller, while it is in training."""

    mlp: Mlp
    policy_id: str = "in training"
    needs_attitude: bool = True

    def reset(self, count: int, rng: np.random.Generator | None = None) -> None:
        """It has no state."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Joint targets (B, J) in rad for observations (B, J + 3) in rad."""
        return self.mlp(observation)


@dataclass
class NoisyObservation:
    """A policy that sees its observations with noise: s* = s + x, x normal (the paper's equation 14)."""

    actor: Actor
    sigma: float  # rad, on every entry

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(0)

    @property
    def policy_id(self) -> str:
        """The policy's."""
        return self.actor.policy_id

    @property
    def needs_attitude(self) -> bool:
        """The policy's."""
        return self.actor.needs_attitude

    def reset(self, count: int, rng: np.random.Generator | None = None) -> None:
        """Start episodes, with noise from `rng`."""
        self._rng = rng or np.random.default_rng(0)
        self.actor.reset(count, rng)

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Joint targets (B, J) in rad for observations (B, J + 3) in rad, of which it sees noisy ones."""
        return self.actor.act(time, observation + self.sigma * self._rng.standard_normal(observation.shape))


def noisy(actor: Actor, sigma: float) -> Actor:
    """The policy with noise of `sigma` (rad) on every entry of its observation; itself without."""
    return NoisyObservation(actor, sigma) if sigma else actor


@dataclass(frozen=True)
class Comparison:
    """The gain of one policy over another under the same conditions; None where no rollout, or too few, can tell."""

    gain: float | None  # mean difference of the returns
    low: float | None  # one-sided bound: the gain is at least this with the confidence asked for
    pairs: int  # of rollouts that ended under both
    rollouts: int  # under each of the two
    vectors: int  # distinct parameter vectors of the pairs
    diverged_before: int
    diverged_after: int
    confidence: float
    before: float | None  # mean return of either, over the same pairs
    after: float | None

    @property
    def enough(self) -> bool:
        """Whether enough rollouts ended under both policies to stand for all."""
        return self.pairs >= max(LEAST_SHARE * self.rollouts, min(LEAST_PAIRS, self.rollouts))

    @property
    def better(self) -> bool:
        """Whether the new policy is better with confidence, and makes no more simulations diverge."""
        gains = self.low is not None and self.low > 0.0
        return gains and self.enough and self.diverged_after <= self.diverged_before

    def statement(self) -> str:
        """The verdict in a sentence."""
        count = str(self.rollouts) if self.pairs == self.rollouts else f"{self.pairs} of {self.rollouts}"
        seen = f"on {count} held-out rollouts of {counted(self.vectors, 'parameter draw')}"
        gain = "too few to tell the gain"
        if self.low is not None:
            gain = f"gain at least {self.low:.0f} with {100 * self.confidence:.4g} % confidence"
        returns = "" if self.before is None else f"return {self.before:.0f} -> {self.after:.0f} "
        verdict = "better" if self.better else "not better with confidence"
        return f"{verdict}: {returns}{seen}, {gain}{self._lost()}"

    def _lost(self) -> str:
        if not (self.diverged_before or self.diverged_after):
            return ""
        few = "" if self.enough else ", which leaves too few"
        return f", {self.diverged_after} diverged under the new policy and {self.diverged_before} under the other{few}"


def compare_paired(
    before: Evaluation, after: Evaluation, vectors: np.ndarray | None = None, confidence: float = 0.95
) -> Comparison:
    """Student's t on the mean differences of the parameter vectors, each with its share of the rollouts as its weight.

    The variance of a weighted mean of V independent values with shares s is estimated by q / (1 - q) times their
    weighted variance, q the sum of s^2, which for equal shares is the usual one; degrees of freedom are V - 1.

    Args:
      before: of the rival.
      after: of the new policy, under the same conditions.
      vectors: (n,) which parameter vector a rollout has; None if each has its own. Where all have the same one, the
        model is sure of it: only their scenarios differ then, and each rollout stands for itself.
      confidence: of the lower bound of the gain.
    """
    lost = np.isnan(before.returns), np.isnan(after.returns)
    valid = ~(lost[0] | lost[1])
    old, new = before.returns[valid], after.returns[valid]
    own = np.arange(len(valid)) if vectors is None else vectors
    distinct = len(np.unique(own[valid]))
    if len(np.unique(own)) == 1:
        own = np.arange(len(valid))
    _, member, counts = np.unique(own[valid], return_inverse=True, return_counts=True)
    gain = low = None
    if len(old):
        shares, means = counts / len(old), np.bincount(member, new - old) / counts
        gain = float(shares @ means)
        if len(counts) > 1:
            q = shares @ shares
            error = np.sqrt(shares @ np.square(means - gain) * q / (1.0 - q))
            low = float(gain - stdtrit(len(counts) - 1, confidence) * error)
    return Comparison(
        gain, low, len(old), len(valid), distinct, int(lost[0].sum()), int(lost[1].sum()), confidence,
        float(old.mean()) if len(old) else None, float(new.mean()) if len(old) else None,
    )  # fmt: skip
