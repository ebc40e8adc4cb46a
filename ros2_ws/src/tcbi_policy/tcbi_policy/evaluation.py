"""How good a policy is on draws of a model, and whether one is better than another.

conditions = draw_conditions(model, "balance", 64, seed=1)
before, after = (evaluate(policy, model, conditions) for policy in (old, new))
comparison = compare_paired(before, after)
comparison.better        # with 95 % confidence
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from tcbi_policy.artefact import Actor
from tcbi_policy.blocks import OverBlocks, over_blocks
from tcbi_policy.environment import TIMESTEP_S
from tcbi_policy.mlp import Mlp
from tcbi_policy.reward import inclination, progress, simulated_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import Model
from tcbi_sim.tasks import find_task


@dataclass(frozen=True)
class Conditions:
    """n pairs of physical parameters and scenario; every policy that is compared meets the same."""

    parameters: np.ndarray  # (n, P)
    scenarios: list[Scenario]


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of one policy; NaN where a simulation diverged."""

    returns: np.ndarray  # (n,)
    inclination: np.ndarray  # (n,) rad, at the end
    distance: np.ndarray  # (n,) m along the heading at the start
    over_blocks: OverBlocks | None = None  # None where no scenario has blocks

    @property
    def mean_return(self) -> float:
        """Mean over the simulations that did not diverge."""
        return float(np.nanmean(self.returns))

    def summary(self) -> dict[str, float]:
        """Means and spreads, in degrees and m; where there are blocks, also who went over one and how far they came."""
        degrees = np.degrees(self.inclination)
        return {
            "rollouts": len(self.returns),
            "mean_return": self.mean_return,
            "sd_return": float(np.nanstd(self.returns)),
            "final_inclination_deg": float(np.nanmean(degrees)),
            "distance_m": float(np.nanmean(self.distance)),
            "median_distance_m": float(np.nanmedian(self.distance)),
            "diverged": int(np.isnan(self.returns).sum()),
        } | self._blocks()

    def _blocks(self) -> dict[str, float]:
        """How many rollouts went over a block, how many with a foot, and the mean distance of those and the others."""
        if self.over_blocks is None:
            return {}
        ended = np.isfinite(self.distance)
        foot, either = ended & self.over_blocks.foot, ended & (self.over_blocks.trunk | self.over_blocks.foot)
        groups = {"distance_over_blocks_m": either, "distance_not_over_blocks_m": ended & ~either}
        counts = {"over_blocks": int(either.sum()), "foot_over_blocks": int(foot.sum())}
        return counts | {name: float(self.distance[group].mean()) for name, group in groups.items() if group.any()}


def draw_conditions(model: Model, task: str, count: int, seed: int) -> Conditions:
    """Draws of a model's parameters and a task's scenarios, a function of the seed."""
    rng = np.random.default_rng([seed, 104729])
    parameters = model.sample(rng, count)
    return Conditions(parameters, [find_task(task).draw(rng, int(rng.integers(2**31))) for _ in range(count)])


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
    returns = np.nansum(simulated_rewards(out)[:, 0], axis=-1)
    returns, tilt, distance = (np.where(lost, np.nan, values) for values in (returns, *ends))
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
    """The gain of one policy over another under the same conditions."""

    gain: float  # mean difference of the returns
    low: float  # one-sided bound: the gain is at least this with the confidence asked for
    pairs: int
    confidence: float
    before: float  # mean return of either, over the same pairs
    after: float

    @property
    def better(self) -> bool:
        """Whether the new policy is better with confidence."""
        return self.low > 0.0

    def statement(self) -> str:
        """The verdict in a sentence."""
        verdict = "better" if self.better else "not better with confidence"
        return (
            f"{verdict}: return {self.before:.0f} -> {self.after:.0f} on {self.pairs} held-out draws, "
            f"gain at least {self.low:.0f} with {100 * self.confidence:.0f} % confidence"
        )


def compare_paired(before: Evaluation, after: Evaluation, confidence: float = 0.95) -> Comparison:
    """Student's t on the differences; a simulation that diverged under either policy drops out of both."""
    valid = np.isfinite(before.returns) & np.isfinite(after.returns)
    old, new = before.returns[valid], after.returns[valid]
    pairs = len(old)
    if pairs < 2:
        return Comparison(np.nan, -np.inf, pairs, confidence, np.nan, np.nan)
    difference = new - old
    error = difference.std(ddof=1) / np.sqrt(pairs)
    low = difference.mean() - float(stdtrit(pairs - 1, confidence)) * error
    return Comparison(float(difference.mean()), float(low), pairs, confidence, float(old.mean()), float(new.mean()))
