"""Train a policy on draws of a model, in a folder that a killed run resumes from.

    Training(folder, config, model, start, report).run()

The folder holds after a while `checkpoint.safetensors` and `policy.safetensors` with its card. What is reported are
events, each a dict with an `event`: `resumed`, `imitation`, `progress` (steps, total_steps or 0 where only time is
limited, share, mean_return, elapsed_s, remaining_s, None until known), `evaluation` (on fixed seeds) and `done`.

Every set of episodes starts from a seed made of the run's seed and its number, and a checkpoint is written between
sets: so a run gives the same weights whether it was killed or not, on the same machine and library versions. For
TensorBoard the folder `tensorboard` holds what is logged.
"""

import dataclasses
import datetime
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from tcbi_contract.files import replace_file
from tcbi_policy.artefact import Card, Policy, save_policy
from tcbi_policy.configuration import TrainingConfig, check_start
from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.errors import TrainingError
from tcbi_policy.evaluation import Conditions, Network, draw_conditions, evaluate, noisy, step_spread
from tcbi_policy.gaits import CYCLES, Gait
from tcbi_policy.imitation import imitate
from tcbi_policy.mlp import Mlp
from tcbi_policy.randomisation import prior_of, randomised
from tcbi_policy.runs import library_versions
from tcbi_policy.stable_baselines import (
    HexapodVecEnv,
    freeze_actor,
    from_mlp,
    make_algorithm,
    replay_bytes,
    restore_replay,
    restore_tensors,
    state_tensors,
    to_mlp,
)
from tcbi_policy.tensorboard import EventFile
from tcbi_sim.model import Model

EVALUATION_SEED = 20_000_003  # apart from every training seed
Report = Callable[[dict[str, Any]], None]


@dataclass
class State:
    """How far a run is; kept in the checkpoint."""

    sets: int = 0  # of episodes
    steps: int = 0
    elapsed: float = 0.0  # s of wall time, over all its lives
    cpu: float = 0.0  # s of processor time
    imitated: bool = False
    best: float = -np.inf  # mean return on the fixed seeds
    best_steps: int = 0  # when that was
    best_diverged: int = 0  # simulations there; the best is the one with the fewest, and among those of the most return
    curve: list[dict[str, float]] = field(default_factory=list)


class Training:
    """One training run in a folder."""

    def __init__(
        self,
        folder: Path,
        config: TrainingConfig,
        model: Model,
        start: Policy | None = None,
        report: Report | None = None,
    ):
        """Prepare a run, or go on with the one in the folder.

        Args:
          folder: of this run alone.
          config: checked.
          model: what the simulations are drawn from.
          start: a policy to start from; None for scratch (or for `config.imitate`).
          report: receives every progress object.
        """
        self.folder, self.config, self.start, self.version = folder, config.checked(), start, model.version
        if start is not None:
            check_start(self.config, start)
        drawn = prior_of(model, config.seed) if config.prior else model
        self.model = randomised(drawn, config.effects, config.effect_share, config.seed)
        self._report = report or (lambda _: None)
        self.state = State()
        self.conditions: Conditions = draw_conditions(self.model, config.task, config.evaluations, EVALUATION_SEED)
        self.environment = HexapodVectorEnv(
            self.model, config.task, config.environments, config.seed,
            squash=config.algorithm == "ppo", observation_noise=config.observation_noise,
            timestep=config.timestep, threads=config.threads,
        )  # fmt: skip
        torch.set_num_threads(1)  # the same sums in the same order; the physics uses the processors
        self.algorithm = make_algorithm(config, HexapodVecEnv(self.environment, self._reward_scale()))
        self.events = EventFile(folder / "tensorboard")
        self.algorithm.set_logger(Logger(None, [self.events]))
        self.best: Mlp = self.present()
        self._began, self._began_cpu = time.monotonic(), time.process_time()
        self._first_set: tuple[float, int] | None = None  # elapsed s and steps where this life began to train
        if start is not None:
            from_mlp(self.algorithm, start.mlp)
            self.best = self.present()

    def _reward_scale(self) -> float:
        """The configuration's, or one over the spread of a step's reward under a dithering gait."""
        if self.config.reward_scale > 0:
            return self.config.reward_scale
        few = Conditions(self.conditions.parameters[:8], self.conditions.scenarios[:8])
        spread = step_spread(Gait("dither"), self.model, few, self.config.timestep, self.config.threads)
        return 1.0 / spread if spread > 0 else 1.0

    def present(self) -> Mlp:
        """The policy as it is now."""
        return to_mlp(self.algorithm, self.environment.limit)

    def run(self) -> Policy:
        """Train until the steps or the budget are used up; the best policy on the fixed seeds, as an artefact."""
        resumed = self._resume()
        if self.copies:
            self._imitate()
        self.state.imitated = True
        if not resumed:
            self._evaluate()
            self._save()
        if not self.exhausted():
            self.algorithm.num_timesteps = self.state.steps
            self.environment.generation = self.state.sets
            self.algorithm.learn(self._steps_left(), callback=_Progress(self), reset_num_timesteps=False)
            self._count()
        self._clock()
        self._evaluate()
        self.progress()
        policy = self._artefact()
        self._save()
        done: dict[str, Any] = {"policy": str(policy.path), "policy_id": policy.policy_id}
        done |= {"mean_return": self.state.best, "best_steps": self.state.best_steps}
        spent = {"steps": self.state.steps, "elapsed_s": self.state.elapsed, "cpu_s": self.state.cpu}
        self._report({"event": "done", **done, **spent})
        return policy

    @property
    def _set_steps(self) -> int:
        return self.environment.steps * self.config.environments

    @property
    def _total_steps(self) -> int:
        """The configuration's, rounded up to whole sets of episodes; 0 where only time is limited."""
        return math.ceil(self.config.steps / self._set_steps) * self._set_steps

    def _steps_left(self) -> int:
        """More than can be taken where only time is limited."""
        return self._total_steps - self.state.steps if self.config.steps else sys.maxsize

    @property
    def warm_up(self) -> int:
        """Sets of episodes that only fit the value: the configuration's, and at most a quarter of the steps'."""
        if not self.config.steps:
            return self.config.warm_up
        return min(self.config.warm_up, math.ceil(self.config.steps / self._set_steps) // 4)

    @property
    def copies(self) -> bool:
        """Whether it has a gait to copy before it learns by reward."""
        return bool(self.config.imitate) and self.start is None and not self.state.imitated

    def exhausted(self) -> bool:
        """Whether the steps or the budget are used up."""
        return 0 < self.config.steps <= self.state.steps or self.out_of_time()

    def out_of_time(self) -> bool:
        """Whether the budget is used up."""
        self._clock()
        return 0 < self.config.budget_s <= self.state.elapsed

    def _clock(self) -> None:
        now, cpu = time.monotonic(), time.process_time()
        self.state.elapsed += now - self._began
        self.state.cpu += cpu - self._began_cpu
        self._began, self._began_cpu = now, cpu

    def _count(self) -> None:
        """Note the sets that are complete; one that the budget cut short does not count."""
        self.state.sets = self.environment.generation
        self.state.steps = self.state.sets * self._set_steps

    def next_set(self) -> None:
        """Between two sets of episodes: evaluate, save, report, and seed the next one."""
        self._count()
        self._clock()
        due = self.state.sets % self.config.evaluate_every == 0
        if due:
            self._evaluate()
        if due or self.config.algorithm == "ppo":
            self._save()
        self.progress()
        seed = [self.config.seed, self.state.sets]
        number = int(np.random.SeedSequence(seed).generate_state(1)[0])
        np.random.seed(number)
        torch.manual_seed(number)
        self.algorithm.action_space.seed(number)
        freeze_actor(self.algorithm, self.state.sets < self.warm_up)

    def progress(self) -> None:
        """Say how far the run is."""
        last = self.state.curve[-1]["mean_return"] if self.state.curve else float("nan")
        steps = {"steps": self.state.steps, "total_steps": self._total_steps, "mean_return": last}
        times = {"share": self._share(), "elapsed_s": self.state.elapsed, "remaining_s": self._remaining()}
        self._report({"event": "progress", **steps, **times})

    def _share(self) -> float:
        """Of the steps or of the budget, whichever ends the training first, 0 to 1."""
        shares = [self.state.steps / self.config.steps] if self.config.steps else []
        if self.config.budget_s > 0:
            shares.append(self.state.elapsed / self.config.budget_s)
        return min(1.0, max(shares))

    def _remaining(self) -> float | None:
        """Seconds of training that are left: at the speed of this life's sets, and at most the budget's rest.

        None before the first set is done: the start-up, the copying of a gait and an earlier life tell no speed.
        """
        elapsed, steps = self.state.elapsed, self.state.steps
        limits = []
        if self.config.steps and not self.copies:
            self._first_set = self._first_set or (elapsed, steps)
            began, before = self._first_set
            if steps > before:
                limits.append((elapsed - began) * (self.config.steps - steps) / (steps - before))
        if self.config.budget_s > 0:
            limits.append(self.config.budget_s - elapsed)
        return max(0.0, min(limits)) if limits else None

    def _imitate(self) -> None:
        cycle = CYCLES[self.config.imitate]

        def told(number: int, error: float) -> None:
            self._report(
                {"event": "imitation", "round": number + 1, "rounds": self.config.imitate_rounds, "error_rad": error}
            )
            self._clock()
            self.progress()

        teacher = HexapodVectorEnv(
            self.model, self.config.task, self.config.environments, self.config.seed + 1,
            timestep=self.config.timestep, threads=self.config.threads,
        )  # fmt: skip
        imitate(self.algorithm, teacher, cycle, self.config.imitate_rounds, told, self.out_of_time)

    def _evaluate(self) -> None:
        if self.state.curve and self.state.curve[-1]["steps"] == self.state.steps:
            return
        present = self.present()
        actor = noisy(Network(present), self.config.observation_noise)
        result = evaluate(actor, self.model, self.conditions, self.config.timestep, self.config.threads).summary()
        self._clock()
        point = {"steps": self.state.steps, "cpu_s": round(self.state.cpu, 1), **result}
        self.state.curve.append(point)
        rank, best = (-result["diverged"], result["mean_return"]), (-self.state.best_diverged, self.state.best)
        if len(self.state.curve) == 1 or rank > best:
            self.state.best_diverged, self.state.best = int(result["diverged"]), result["mean_return"]
            self.state.best_steps = self.state.steps
            self.best = present
        self.events.add(self.state.steps, {f"evaluation/{name}": value for name, value in result.items()})
        self._report({"event": "evaluation", **point})

    def _artefact(self) -> Policy:
        weights, particles = self.model.weights, self.model.particles
        mean = weights @ particles
        spread = np.sqrt(weights @ np.square(particles - mean))
        posterior = {p.name: {"unit": p.unit, "mean": float(m), "sd": float(s)}
                     for p, m, s in zip(self.model.parameters, mean, spread, strict=True)}  # fmt: skip
        config = dataclasses.asdict(self.config)
        taken = {"steps_taken": self.state.steps, "cpu_s": round(self.state.cpu, 1),
                 "mean_return": self.state.best, "best_steps": self.state.best_steps,
                 "evaluation_seed": EVALUATION_SEED}  # fmt: skip
        return save_policy(self.folder / "policy", self.best, Card(
            name=self.config.task, task=self.config.task, model=self.version, posterior=posterior,
            training={**config, **taken},
            curve=self.state.curve, libraries=library_versions(), parent=self.start.policy_id if self.start else "",
            created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        ))  # fmt: skip

    def _save(self) -> None:
        tensors, texts = state_tensors(self.algorithm)
        tensors |= {f"best/{name}": torch.as_tensor(array) for name, array in self.best.tensors().items()}
        texts["state"] = json.dumps(dataclasses.asdict(self.state))
        replay = self._replay_file()
        if self.config.algorithm == "sac":
            replace_file(replay, replay_bytes(self.algorithm))
        replace_file(self.folder / "checkpoint.safetensors", save(tensors, texts))  # from here on the new one counts
        for old in self.folder.glob("replay-*.npz"):
            if old != replay:
                old.unlink()

    def _replay_file(self) -> Path:
        """What SAC remembers at the present step: a kill between two files leaves the old pair or the new one."""
        return self.folder / f"replay-{self.state.steps}.npz"

    def _resume(self) -> bool:
        path = self.folder / "checkpoint.safetensors"
        if not path.exists():
            return False
        with safe_open(path, "pt") as file:
            tensors, texts = {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
        restore_tensors(self.algorithm, tensors, texts)
        self.state = State(**json.loads(texts["state"]))
        best = {name.removeprefix("best/"): t.numpy() for name, t in tensors.items() if name.startswith("best/")}
        self.best = Mlp.from_tensors(best, self.environment.limit)
        if self.config.algorithm == "sac":
            if not self._replay_file().exists():
                raise TrainingError(
                    f"{path}: {self._replay_file().name} belongs to it and is not there; bring it back, or remove the "
                    "checkpoint to train afresh"
                )
            restore_replay(self.algorithm, self._replay_file())
        self._report({"event": "resumed", "steps": self.state.steps})
        return True


class _Progress(BaseCallback):
    """Stable-Baselines3's hook between sets of episodes."""

    def __init__(self, training: Training):
        super().__init__()
        self._training = training
        self._sets, self._taken = -1, 0  # the set at work, and how many steps of it
        self._learns_by_the_step = training.config.algorithm == "sac"

    def _on_rollout_start(self) -> None:
        sets = self._training.environment.generation
        if sets != self._sets:
            self._sets, self._taken = sets, 0
            self._training.next_set()

    def _on_step(self) -> bool:
        """Whether to go on, asked before the step is remembered.

        What counts are whole sets. PPO has learnt nothing from one that is cut short, SAC from each of its steps: SAC
        therefore ends at the first step of a set only, which is dropped.
        """
        self._taken += 1
        complete = self._training.environment.generation != self._sets
        if complete or (self._learns_by_the_step and self._taken > 1):
            return True
        return not self._training.out_of_time()
