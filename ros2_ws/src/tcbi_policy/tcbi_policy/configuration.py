"""How a policy is trained: the settings, and the presets that were found by experiment or given by the paper."""

import dataclasses
import json
import math
from dataclasses import dataclass

from tcbi_contract.errors import describe
from tcbi_contract.names import JOINT_LIMIT
from tcbi_policy.artefact import Policy
from tcbi_policy.errors import TrainingError
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.tasks import find_task

HIGHEST_SEED = 2**32 - 1  # that Stable-Baselines3 takes


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that a training run depends on, apart from the model."""

    task: str
    algorithm: str = "ppo"  # or sac
    seed: int = 0
    steps: int = 200_000  # control steps of all environments together; 0 for no limit, where there is one in time
    budget_s: float = 0.0  # stop after this much time; 0 for no limit
    environments: int = 64
    timestep: float = 0.01  # s of the physics
    threads: int = 0  # 0 for all processors
    prior: bool = False  # draw from the prior of the model's parameters instead of its posterior
    effects: tuple[str, ...] = ()  # further effects ("name" or "name:site") that some of the episodes have
    effect_share: float = 0.5  # of the episodes that have each of them
    observation_noise: float = 0.0  # rad, standard deviation on each entry of the observation (equation 14)
    learning_rate: float = 1e-3
    batch_size: int = 256
    gamma: float = 0.8
    layers: tuple[int, ...] = (256, 256)
    reward_scale: float = 1e-2  # of what the algorithm sees; 0 to measure it: one over the spread of a step's reward
    epochs: int = 10  # PPO: passes over each set of episodes
    gae_lambda: float = 0.9  # PPO
    noise: float = 0.4  # PPO: standard deviation at the start, before the tanh
    clip: float = 0.2  # PPO
    warm_up: int = 0  # PPO: sets of episodes that only fit the value of a policy that is already there
    updates: int = 8  # SAC: gradient steps a step of all environments
    tau: float = 0.005  # SAC
    buffer: int = 300_000  # SAC
    imitate: str = ""  # a cyclic gait that the policy copies before it learns by reward
    imitate_rounds: int = 4  # sets of episodes for it
    evaluate_every: int = 5  # sets of episodes between evaluations on fixed seeds
    evaluations: int = 48  # rollouts each

    def randomisation(self) -> str:
        """What is drawn at random beyond the model, in words; empty if nothing is."""
        noise = f"noise of {self.observation_noise:g} rad on the observation" if self.observation_noise else ""
        effects = f"{', '.join(self.effects)} in {self.effect_share:.0%} of the episodes" if self.effects else ""
        return " and ".join(part for part in (noise, effects) if part)

    def to_json(self) -> str:
        """The configuration as it lies in a run's folder."""
        return json.dumps(dataclasses.asdict(self), indent=1) + "\n"

    @staticmethod
    def from_json(text: str) -> "TrainingConfig":
        """Read a configuration.

        Raises:
          TrainingError: it is none, or of another version of tcbi.
        """
        try:
            data = json.loads(text)
            data |= {key: tuple(data.get(key, ())) for key in ("layers", "effects")}
            return TrainingConfig(**data)
        except (ValueError, TypeError, KeyError) as e:
            raise TrainingError(f"not a training configuration: {e}; start the run again in a new folder") from e

    def checked(self) -> "TrainingConfig":
        """This configuration, if it makes sense.

        Raises:
          TrainingError: with all faults.
        """
        faults = []
        if self.algorithm not in ("ppo", "sac"):
            faults.append(describe("algorithm", self.algorithm, "ppo or sac"))
        if not (self.steps > 0 or (self.steps == 0 and self.budget_s > 0)):
            faults.append(describe("steps", self.steps, "more than 0, or 0 where budget_s is more than 0"))
        positive = ("environments", "learning_rate", "batch_size", "evaluate_every", "evaluations")
        faults += [describe(name, getattr(self, name), "more than 0") for name in positive if getattr(self, name) <= 0]
        if not 0 <= self.seed <= HIGHEST_SEED:
            faults.append(describe("seed", self.seed, f"0 to {HIGHEST_SEED}"))
        if not 0.0 < self.gamma < 1.0:
            faults.append(describe("gamma", self.gamma, "between 0 and 1"))
        for name in ("observation_noise", "budget_s", "reward_scale"):
            if not 0 <= getattr(self, name) < math.inf:
                faults.append(describe(name, getattr(self, name), "0 or more, and finite"))
        if not 0.0 < self.effect_share <= 1.0:
            faults.append(describe("effect_share", self.effect_share, "more than 0 and up to 1"))
        if faults:
            raise TrainingError("; ".join(faults))
        return self


def check_start(config: TrainingConfig, start: Policy) -> None:
    """Refuse a policy to start from whose network is not the training's.

    Raises:
      TrainingError: its hidden layers have other widths, or its targets another limit.
    """
    if not math.isclose(start.mlp.limit, JOINT_LIMIT, rel_tol=1e-6):
        raise TrainingError(
            describe(f"limit of policy {start.policy_id}", f"{start.mlp.limit:g} rad", f"{JOINT_LIMIT:g} rad")
            + "; train from scratch, or start from another policy"
        )
    if start.mlp.layers != config.layers:
        raise TrainingError(
            describe(f"hidden layers of policy {start.policy_id}", start.mlp.layers, str(config.layers))
            + "; train from scratch, or start from another policy"
        )


_PAPER = TrainingConfig(
    "", "sac", steps=3_000_320, environments=16, updates=16, learning_rate=1e-3, batch_size=256, gamma=0.99, tau=0.005,
    buffer=1_000_000, evaluate_every=25,
)  # fmt: skip

PRESETS: dict[str, dict[str, TrainingConfig]] = {
    # PPO: a policy that is useful after minutes on two cores
    "fast": {
        "balance": TrainingConfig("balance", steps=81_920, environments=32, batch_size=128, evaluate_every=8),
        "forward": TrainingConfig(
            "forward",
            steps=331_200,
            environments=32,
            imitate="stride",
            warm_up=1,
            noise=0.15,
            learning_rate=3e-4,
            reward_scale=1e-3,
            evaluations=32,
        ),
    },
    # SAC with the paper's settings (Table 2), one update a step; about half a day of processor time each. Its 3 and 5
    # million steps are rounded up to whole sets of episodes
    "paper": {
        "balance": dataclasses.replace(_PAPER, task="balance"),
        "forward": dataclasses.replace(_PAPER, task="forward", steps=5_001_600, reward_scale=1e-3),
    },
}


def preset(name: str, task: str) -> TrainingConfig:
    """A preset for a task; a user's own task is trained as balance is, with as many episodes.

    Raises:
      UnknownNameError: there is none of this name, or no such task.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, tuple(PRESETS))
    if task in PRESETS[name]:
        return PRESETS[name][task]
    like = PRESETS[name]["balance"]
    longer = find_task(task).duration / find_task("balance").duration
    return dataclasses.replace(like, task=task, reward_scale=0.0, steps=round(like.steps * longer))
