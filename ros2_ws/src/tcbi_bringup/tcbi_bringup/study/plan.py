"""What a study does: robots, tasks, methods, and how much of everything."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from tcbi_bringup.demo import plan as demo
from tcbi_bringup.errors import WrongCallError
from tcbi_contract.errors import describe
from tcbi_sim.errors import UnknownNameError

Key = tuple[Any, ...]  # of a piece of work: the stage, and what it is done for
FIRST = "first"  # the policy that everybody starts from, not retrained
EFFECT = "tcbi_effect"
WINNER = "tcbi"  # the method that the others are tested against


@dataclass(frozen=True)
class Contestant:
    """A way to the posterior that a policy is retrained on."""

    label: str
    method: str  # by the name that `./tcbi infer --method` knows
    statistics: tuple[str, ...] = ()  # instead of the method's own
    with_effect: bool = False  # in the model with the effect that the diagnosis found


CONTESTANTS = {
    "fixed_dr": Contestant("fixed randomisation", "prior"),
    "abc": Contestant("ABC", "abc_smc"),
    "simopt": Contestant("SimOpt", "simopt"),
    "bayesopt": Contestant("Bayesian optimisation", "bayesopt"),
    "tcbi_reward": Contestant("TCBI, reward only", "calibrated", ("reward",)),
    "tcbi_paper": Contestant("TCBI as published", "paper"),
    WINNER: Contestant("TCBI", "calibrated"),
    EFFECT: Contestant("TCBI with the effect", "calibrated", with_effect=True),
}
LABELS = {FIRST: "first policy", **{name: c.label for name, c in CONTESTANTS.items()}}


@dataclass(frozen=True)
class TaskPlan:
    """How much of one task.

    Attributes:
      first_policy: collects the rollouts, and is where every retraining starts.
      rollouts: that are collected of each robot.
      particles, generations: of an inference, the same for every method that simulates.
      steps: of each retraining, of all simulations together.
      deployments: of each retrained policy on the robot.
      noisy: deployments under each level of sensor noise.
    """

    first_policy: str
    rollouts: int
    particles: int
    generations: int
    steps: int
    deployments: int
    noisy: int

    def budget(self, method: str) -> dict[str, Any]:
        """Settings of an inference. `prior` simulates nothing, so its draws are as many as it takes by default."""
        return {} if method == "prior" else {"particles": self.particles, "generations": self.generations}


@dataclass(frozen=True)
class Plan:
    """The whole study.

    Attributes:
      robots: number and strength of what is hidden in each; which effect follows from the number.
      contestants: names in CONTESTANTS.
      noise: rad, standard deviations of Figures 12 and 13.
      diagnosis: which of the demo's plans the effect is looked for with.
    """

    tasks: dict[str, TaskPlan]
    robots: tuple[tuple[int, str], ...]
    contestants: tuple[str, ...] = tuple(CONTESTANTS)
    noise: tuple[float, ...] = (0.02, 0.04, 0.06, 0.08)
    diagnosis: demo.Plan = demo.QUICK

    def names(self) -> tuple[list[int], list[str], list[str]]:
        """Robots, tasks and contestants."""
        return [robot for robot, _ in self.robots], list(self.tasks), list(self.contestants)

    def pieces(self) -> Iterator[Key]:
        """All pieces of work, robot by robot; each needs only those before it."""
        for robot, _ in self.robots:
            if any(CONTESTANTS[name].with_effect for name in self.contestants):
                yield ("diagnose", robot)
            for task in self.tasks:
                yield ("collect", task, robot)
                yield ("deploy", task, robot, FIRST)
                for name in self.contestants:
                    for stage in ("infer", "train", "deploy", "noise"):
                        yield (stage, task, robot, name)


HOUR = Plan(
    {
        "balance": TaskPlan("balance-early", 10, 32, 5, 20_480, 15, 5),  # 30 deployments of each method in all
        "forward": TaskPlan("forward-early", 8, 24, 4, 48_000, 15, 2),
    },
    ((11, "strong"), (12, "strong")),
    tuple(name for name in CONTESTANTS if name != "tcbi_paper"),
)
FULL = Plan(
    {
        "balance": TaskPlan("balance-early", 20, 50, 15, 81_920, 30, 30),
        "forward": TaskPlan("forward-early", 20, 50, 15, 331_200, 30, 30),
    },
    tuple((seed, "strong") for seed in range(11, 19)),
    diagnosis=demo.FULL,
)
PRESETS = {"hour": HOUR, "full": FULL}


# s of a piece, by stage and task, in the preset `hour` on two cores: for the estimate of the time left alone
COSTS = {
    "balance": {"collect": 5.0, "deploy": 7.0, "infer": 21.0, "train": 24.0, "noise": 11.0},
    "forward": {"collect": 15.0, "deploy": 31.0, "infer": 66.0, "train": 56.0, "noise": 13.0},
}
DIAGNOSIS_COST, NO_INFERENCE_COST = 21.0, 2.0


def cost(piece: Key) -> float:
    """How much time a piece takes, beside the others."""
    if piece[0] == "diagnose":
        return DIAGNOSIS_COST
    if piece[0] == "infer" and CONTESTANTS[piece[3]].method == "prior":
        return NO_INFERENCE_COST
    return COSTS.get(piece[1], COSTS["balance"])[piece[0]]


def chosen(preset: str, robots: str = "", tasks: str = "", contestants: str = "") -> Plan:
    """A preset, or a part of it.

    Args:
      preset: by name.
      robots: numbers with commas; empty for the preset's.
      tasks: names with commas.
      contestants: names with commas; `tcbi_effect` brings `tcbi`, which it is compared with.

    Raises:
      UnknownNameError: there is no such preset, task or method.
      WrongCallError: a robot is no number.
    """
    if preset not in PRESETS:
        raise UnknownNameError("preset", preset, tuple(PRESETS))
    plan = PRESETS[preset]
    if robots:
        texts = [text.strip() for text in robots.split(",")]
        if not all(text.isdecimal() for text in texts):
            raise WrongCallError(describe("robots", robots, "numbers from 0 on, with commas"))
        plan = dataclasses.replace(plan, robots=tuple((n, "strong") for n in dict.fromkeys(map(int, texts))))
    if tasks:
        names = _known(tasks, "task of the study", plan.tasks)
        plan = dataclasses.replace(plan, tasks={name: plan.tasks[name] for name in names})
    if contestants:
        names = _known(contestants, "method of the study", CONTESTANTS)
        if EFFECT in names and WINNER not in names:
            names.insert(names.index(EFFECT), WINNER)
        plan = dataclasses.replace(plan, contestants=tuple(names))
    return plan


def of_what_is_there(
    plan: Plan, keys: Iterable[Key], named: Sequence[str] = ("", "", ""), asked: Sequence[Iterable[Any]] = ((), (), ())
) -> Plan:
    """The plan of a study as far as it has been worked on, or is to be; what is named is taken as it is.

    Args:
      plan: by `chosen`, with these names.
      keys: of the pieces that there are.
      named: robots, tasks, contestants, as they were given to `chosen`.
      asked: robots, tasks, contestants that the study's newest call is to work on.
    """
    robots = {key[-1] if key[0] == "diagnose" else key[2] for key in keys} | set(asked[0])
    tasks = {key[1] for key in keys if len(key) > 2} | set(asked[1])
    contestants = {key[3] for key in keys if len(key) > 3} | set(asked[2])
    if robots and not named[0]:
        strength = dict(plan.robots)
        plan = dataclasses.replace(plan, robots=tuple((n, strength.get(n, "strong")) for n in sorted(robots)))
    if tasks and not named[1]:
        plan = dataclasses.replace(plan, tasks={name: of for name, of in plan.tasks.items() if name in tasks})
    if contestants and not named[2]:
        plan = dataclasses.replace(plan, contestants=tuple(name for name in CONTESTANTS if name in contestants))
    return plan


def _known(text: str, what: str, names: dict) -> list[str]:
    wanted = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in wanted:
        if name not in names:
            raise UnknownNameError(what, name, tuple(names))
    return wanted
